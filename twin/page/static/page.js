// The technician's page. What comes from the server is put in as text, never as markup.
"use strict";

const PHASES = [t("idle"), t("suction"), t("hold"), t("blow-off")];
const PHASE_COLOURS = ["--idle", "--suction", "--hold", "--blow"];
const DEEDS = {
  acknowledged: t("Acknowledge"), shelved: t("Shelve"), unshelved: t("Unshelve"),
  out_of_service: t("Take out of service"), in_service: t("Return to service"),
};
const TIMES = [[900, t("15 minutes")], [3600, t("1 hour")], [4 * 3600, t("4 hours")], [8 * 3600, t("8 hours")]];
const KEPT_S = 300; // of rows, to look back at
const RING_S = 60; // of rows that the server has; what is before them is in logs
const SHOWN = [t("size"), t("how sure"), t("cost")]; // of what speaks for an alarm, at first sight
const LIGHTS = ["red", "grey", "yellow", "green"]; // the worst first
const MOST_MARKS = 20; // of alarms in a trend
const AROUND_S = 60; // that is shown before and after an alarm
const LONGEST_ALARM_S = 600; // that is shown of one that lasts
const LONGEST_S = 48 * 3600; // that the server gives at once
const LIMITS_MS = 2000; // between looks at the limits while they are shown
const BACK_S = 400 * 86400; // as far as one can look back
const FOLLOW_S = 2; // between looks at a range that ends now, at least
const NO_CURVE = {
  time: [], measured_low: [], measured_high: [], expected_low: [], expected_high: [],
  range: [0, 0], phases: [], gaps: [], alarms: [], share: 1, damaged: 0, logged: true, trouble: "",
};
const QUIET = ["shelved", "suppressed", "out_of_service"];

let me = { user: "", csrf: "", may: [], ejectors: [], figures: [] };
let states = [];
let chosen = null; // the ejector whose curves are shown; at first the worst
const mine = new Map(); // alarm -> what has become of what was asked here

async function post(path, what) {
  const headers = { "content-type": "application/json", "x-csrf-token": me.csrf };
  const answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(what) });
  if (answer.status === 401) location.assign("/login");
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error);
  return told;
}

// --- traffic lights ------------------------------------------------------------------------------

function summary(state) {
  const standing = state.alarms.filter((one) => !QUIET.includes(one.state)).length;
  const shelved = state.alarms.filter((one) => one.state === "shelved").length;
  const others = state.alarms.length - standing - shelved;
  const parts = [];
  if (!state.running) parts.push(state.last ? t("since {time}", { time: state.last_seen }) : t("never yet"));
  if (standing) parts.push(tn("{count} alarm", "{count} alarms", standing));
  if (shelved) parts.push(tn("{count} shelved", "{count} shelved", shelved));
  if (others) parts.push(tn("{count} not announced", "{count} not announced", others));
  return parts.join(", ") || t("no alarm");
}

function worstFirst() { // numbers of the ejectors; of the same light, the one with the worse alarm
  const key = (number) => {
    const [first] = states[number].alarms;
    const rank = first ? first.rank : [9, 9];
    return [LIGHTS.indexOf(states[number].light), ...rank, number];
  };
  return states.map((_, number) => number).sort((a, b) => inOrder(key(a), key(b)));
}

function inOrder(one, other) { // of lists of numbers, as of words
  const at = one.findIndex((value, i) => value !== other[i]);
  return at < 0 ? 0 : one[at] - other[at];
}

function light(number) {
  const state = states[number];
  return element(
    "button",
    {
      type: "button", class: `ejector ${state.light}`, "aria-pressed": String(number === chosen),
      "data-light": state.light, "data-number": number, onclick: () => choose(number, true),
    },
    icon(state.light),
    element("b", {}, state.words),
    element("span", {}, `${state.name}: ${summary(state)}`),
  );
}

function showLights() {
  const old = $("ejectors");
  const focused = old.contains(document.activeElement) ? document.activeElement.dataset.number : null;
  const lights = worstFirst().map(light);
  const key = lights.map((one) => one.outerHTML).join("");
  if (old.dataset.key === key) return;
  old.dataset.key = key;
  old.replaceChildren(...lights);
  const again = lights.find((one) => one.dataset.number === focused);
  if (again) again.focus();
  const worst = lights.map((one) => one.dataset.number)[0];
  document.title = `${states[worst].words} – ${states[worst].name}`;
}

function choose(number, alone = false) { // its curves; with its alarms alone, or among all others
  if (alone && states.length > 1) $("whose").value = String(number);
  if (number !== chosen) {
    past.leave();
    chosen = number;
    live.clear();
    watch();
  }
  showStates();
  if (!$("trends").hidden) showTrend();
  if (!$("history").hidden) loadHistory();
  loadLimits();
}

function showBanner() {
  const state = states[chosen];
  const said = [];
  if (!state.running) {
    const how = state.ended ? t("twin run has ended") : t("twin run does not answer");
    said.push(state.last
      ? t("Not running since {time}: {why}. What follows is as it was then.", { time: state.last_seen, why: how })
      : t("Not running: twin run has not been started yet."));
  }
  if (state.trouble) said.push(state.trouble);
  if (states.length > 1 && said.length) said.unshift(`${state.name}:`);
  $("banner").hidden = !said.length;
  if ($("banner").textContent !== said.join(" ")) $("banner").textContent = said.join(" ");
  document.querySelector(".live").classList.toggle("stale", !state.running);
}

// --- alarms --------------------------------------------------------------------------------------

function isShown(alarm) {
  switch ($("which").value) {
    case "unseen": return !alarm.acknowledged;
    case "urgent": return alarm.priority !== "low" && !QUIET.includes(alarm.state);
    case "quiet": return QUIET.includes(alarm.state);
  }
  return true;
}

function offerEjectors() {
  $("whose-label").hidden = states.length < 2;
  const names = [["", t("all")], ...states.map(({ name }, number) => [String(number), name])];
  if ([...$("whose").options].map((one) => one.text).join() === names.map(([, name]) => name).join()) return;
  $("whose").replaceChildren(...names.map(([value, name]) => element("option", { value }, name)));
}

function allAlarms() { // of all ejectors, or of the one that is wanted alone; the worst first
  const whose = $("whose").value;
  const found = states.flatMap((state, of) => state.alarms.map((alarm) => ({ ...alarm, of })))
    .filter(({ of }) => !whose || whose === String(of));
  const key = ({ rank, raised }) => [...rank, raised || 0];
  return found.sort((one, other) => inOrder(key(one), key(other)));
}

const keyOf = (alarm) => `${alarm.of} ${alarm.alarm}`;

function showAlarms() {
  const known = allAlarms();
  const shown = known.filter(isShown);
  $("count").textContent = known.length ? `(${known.length})` : "";
  const box = $("alarms");
  const ageless = (name, value) => (["times", "quiet_until", "comments"].includes(name) ? undefined : value);
  const comments = shown.map((one) => one.comments.length);
  const key = JSON.stringify([chosen, $("whose").value, me.user, states.map((one) => one.running), shown, comments, [...mine]], ageless);
  if (box.dataset.key !== key) {
    const open = new Set([...box.querySelectorAll("details[open]")].map((one) => one.dataset.key));
    const focused = document.activeElement && document.activeElement.dataset.focus;
    box.dataset.key = key;
    box.replaceChildren(...(shown.length ? shown.map((one) => alarmCard(one, open)) : [nothing(known)]));
    const again = focused && box.querySelector(`[data-focus="${CSS.escape(focused)}"]`);
    if (again) again.focus();
  }
  for (const one of box.querySelectorAll("[data-since]")) {
    one.textContent = since(shown.find((alarm) => keyOf(alarm) === one.dataset.since));
  }
}

function since(alarm) {
  const { raised, cleared, seen } = alarm.times || {};
  const said = raised ? [t("since {time}", { time: raised })] : [];
  if (cleared) said.push(t("gone since {time}", { time: cleared }));
  if (seen) said.push(t("acknowledged {time} by {who}", { time: seen, who: alarm.seen_by }));
  if (alarm.quiet_until) said.push(t("shelved until {time}", { time: alarm.quiet_until }));
  return said.join("; ");
}

function nothing(known) {
  const whose = $("whose").value;
  const looked = whose ? [states[whose]] : states;
  const unknown = looked.some((state) => state.trouble || state.last === null);
  const none = known.length ? t("No alarm is like that.") : t("No alarm stands.");
  return element("p", { class: "nothing" }, unknown ? t("The alarms are not known.") : none);
}

function alarmCard(alarm, open) {
  const where = [states[alarm.of].name, alarm.where].filter(Boolean).join(": ");
  return element(
    "article", { class: `alarm ${alarm.state} ${alarm.priority}`, "data-alarm": alarm.alarm, "data-of": alarm.of },
    element("div", { class: "top" }, element("h3", {}, alarm.what),
      element("span", { class: "chip" }, alarm.priority_words),
      element("span", { class: "chip state" }, alarm.state_words)),
    element("p", { class: "since", "data-since": keyOf(alarm) }),
    element("p", { class: "todo" }, alarm.action),
    rows([[t("where"), where], ...alarm.facts.filter(([name]) => SHOWN.includes(name))]),
    ...comments(alarm),
    evidence(alarm, open),
    deeds(alarm),
    ...asked(alarm),
  );
}

function comments({ comments: said }) {
  return said.map((one) => element("p", { class: "comment" },
    element("q", {}, one.text), ` ${one.who}, ${one.when}`));
}

function evidence(alarm, open) {
  const facts = alarm.facts.filter(([name]) => !SHOWN.includes(name));
  return element(
    "details", { "data-key": keyOf(alarm), open: open.has(keyOf(alarm)) },
    element("summary", { "data-focus": `why ${keyOf(alarm)}` }, t("Evidence")),
    rows([[t("what it is"), alarm.sentence], [t("if nobody acts"), alarm.consequence], ...facts, [t("alarm"), alarm.alarm]]));
}

function reportButton(of, { report, alarm }) {
  if (!report) return null;
  const onclick = () => {
    const href = `/reports/${of}/${report}`;
    $("report-open").href = $("report-frame").src = href;
    $("report").showModal();
  };
  return element("button", { type: "button", "data-focus": `report ${of} ${alarm}`, onclick }, t("See diagnosis"));
}

function curveButton(alarm) { // the time around it; without a time it is that of its ejector, live
  if (!alarm.raised && alarm.of === chosen) return null;
  const onclick = () => (alarm.raised ? showAround(alarm) : choose(alarm.of));
  return element("button", { type: "button", "data-focus": `curve ${keyOf(alarm)}`, onclick }, t("Show its curve"));
}

function showAround({ of, raised, cleared }) {
  choose(of);
  showTab("now");
  const until = cleared ? cleared + AROUND_S / 2 : raised + AROUND_S;
  past.open(raised - AROUND_S, Math.max(raised + AROUND_S, Math.min(until, raised + LONGEST_ALARM_S)));
  document.querySelector(".live").scrollIntoView({ block: "nearest" });
  $("plot").focus({ preventScroll: true });
}

function possible(alarm) {
  const found = alarm.acknowledged ? [] : ["acknowledged"];
  if (alarm.state === "shelved") return [...found, "unshelved"];
  return [...found, alarm.state === "out_of_service" ? "in_service" : "shelved"];
}

function deeds(alarm) {
  const besides = [reportButton(alarm.of, alarm), curveButton(alarm)];
  if (!me.user) {
    return element("div", { class: "deeds" },
      element("a", { class: "button", href: "/login" }, t("Log in to acknowledge")), ...besides);
  }
  if (!me.may.length) {
    const said = t("{user} may look, and acknowledges nothing", { user: me.user });
    return element("div", { class: "deeds" }, element("span", {}, said), ...besides);
  }
  const allowed = possible(alarm).filter((deed) => me.may.includes(deed));
  const comment = element("button", {
    type: "button", "data-focus": `comment ${keyOf(alarm)}`, onclick: () => offerComment(alarm),
  }, t("Comment …"));
  return element("div", { class: "deeds" }, ...allowed.map((deed) => deedButton(alarm, deed)),
    alarm.episode && me.may.includes("commented") ? comment : null, ...besides);
}

function deedButton(alarm, deed) {
  return element("button", {
    type: "button", class: deed === "acknowledged" ? "first" : false,
    "data-focus": `${deed} ${keyOf(alarm)}`,
    disabled: alarm.asked.some((one) => one.deed === deed),
    onclick: () => (deed === "shelved" ? offerTimes(alarm) : ask(alarm, deed)),
  }, deed === "shelved" ? `${DEEDS[deed]} …` : DEEDS[deed]);
}

function asked(alarm) {
  const waits = states[alarm.of].running ? t("asked, a moment …") : t("asked; waits for the next run");
  const said = alarm.asked.map((one) => element(
    "p", { class: "asked", role: "status" }, `${DEEDS[one.deed]}: ${waits} (${one.who})`));
  const own = mine.get(keyOf(alarm));
  if (own) said.push(element("p", { class: "asked refused", role: "alert" }, own));
  return said;
}

function offerTimes(alarm) {
  $("shelve-what").textContent = t("{alarm} is not announced for a time; then it is by itself.", { alarm: alarm.what });
  const times = TIMES.filter(([seconds]) => seconds <= alarm.longest_shelving_s);
  const choice = (text, deed, seconds) => element("button", {
    type: "button", onclick: () => { $("shelve").close(); ask(alarm, deed, seconds); },
  }, text);
  $("shelve-times").replaceChildren(
    ...times.map(([seconds, text]) => choice(text, "shelved", seconds)),
    ...(me.may.includes("out_of_service")
      ? [choice(t("Out of service, until it is returned to service"), "out_of_service", 0)] : []));
  $("shelve").showModal();
}

function offerComment(alarm) {
  $("comment-what").textContent = `${states[alarm.of].name}: ${alarm.what}`;
  $("comment-text").value = "";
  $("comment-form").onsubmit = () => comment(alarm, $("comment-text").value);
  $("comment").showModal();
}

async function comment(alarm, text) {
  try {
    await post(`/api/ejectors/${alarm.of}/comments`, { episode: alarm.episode, text });
    mine.delete(keyOf(alarm));
  } catch (error) {
    mine.set(keyOf(alarm), `${t("Comment")}: ${error.message}`);
  }
  showAlarms();
}

async function ask(alarm, deed, seconds = 0) {
  const key = keyOf(alarm);
  const path = `/api/ejectors/${alarm.of}/requests`;
  mine.delete(key);
  try {
    const { request } = await post(path, { alarm: alarm.alarm, deed, seconds });
    alarm.asked.push({ deed, who: me.user });
    showAlarms();
    const why = await answered(`${path}/${request}`);
    if (why) mine.set(key, t("{deed}: refused. {why}", { deed: DEEDS[deed], why }));
  } catch (error) {
    mine.set(key, `${DEEDS[deed]}: ${error.message}`);
  }
  showAlarms();
}

// --- limits --------------------------------------------------------------------------------------

let limitsAsked = 0;

async function loadLimits() {
  if (chosen === null || $("limits").hidden) return;
  const turn = ++limitsAsked;
  const of = chosen;
  let told;
  try {
    told = await get(`/api/ejectors/${of}/limits`);
  } catch (error) {
    $("limits-said").textContent = error.message;
    return;
  }
  if (turn === limitsAsked && of === chosen) showLimits(told);
}

function showLimits({ limits, changes }) {
  const may = me.may.includes("limit_changed");
  $("limits-head").textContent = t("Limits of {ejector}", { ejector: states[chosen].name });
  $("limits-who").textContent = may ? t("A change holds at once, and after a restart.")
    : t("Who has the role configure may change limits.");
  const key = JSON.stringify([chosen, may, states[chosen].running, limits, changes]);
  if ($("limit-cards").dataset.key === key) return;
  $("limit-cards").dataset.key = key;
  const focused = document.activeElement && document.activeElement.dataset.focus;
  $("limit-cards").replaceChildren(...limits.map((limit) => limitCard(limit, may)));
  $("limit-changes").replaceChildren(...(changes.length ? changes.map(changeCard)
    : [element("p", { class: "nothing" }, t("Nobody has changed a limit."))]));
  const again = focused && $("limit-cards").querySelector(`[data-focus="${CSS.escape(focused)}"]`);
  if (again) again.focus();
}

function limitCard(limit, may) {
  const { newest } = limit;
  const button = (text, focus, onclick) => element("button", { type: "button", "data-focus": `${focus} ${limit.key}`, onclick },
    text, element("span", { class: "unseen" }, ` ${limit.title}`));
  return element("article", { class: "limit", "data-limit": limit.key },
    element("div", { class: "top" }, element("h3", {}, limit.title), element("b", {}, limit.value_words)),
    element("p", { class: "dim" }, limit.what),
    limit.is_changed ? element("p", {}, changeWords(newest)) : null,
    limit.is_changed ? element("p", { class: "dim" }, t("configured: {value}", { value: limit.configured_words })) : null,
    ...limit.asked.map(waitingChange),
    may ? element("div", { class: "deeds" },
      button(t("Change …"), "change", () => offerLimit(limit)),
      limit.is_changed ? button(t("Reset …"), "reset", () => offerLimit(limit, true)) : null) : null);
}

const changeWords = ({ words, who, when, reason }) =>
  t("{change} by {who}, {when}: {reason}", { change: words, who, when, reason });

function waitingChange(change) {
  const waits = states[chosen].running ? t("asked, a moment …") : t("asked; waits for the next run");
  return element("p", { class: "asked" }, `${change.words}: ${waits} (${change.who})`);
}

function changeCard(change) {
  return element("article", { class: "change" },
    element("h3", {}, change.title),
    element("p", {}, changeWords(change)),
    change.refusal ? element("p", { class: "asked refused" }, t("refused. {why}", { why: change.refusal })) : null);
}

function offerLimit(limit, reset = false) {
  const { title, value_words: value, range_words: range, configured_words: usual } = limit;
  $("limit-title").textContent = reset ? t("Reset: {limit}", { limit: title }) : t("Change: {limit}", { limit: title });
  $("limit-what").textContent = reset ? t("From {value} back to the configured {usual}.", { value, usual })
    : t("Now {value}; {range} can be set.", { value, range });
  $("limit-label").textContent = t("New value in {unit}", { unit: limit.unit });
  $("limit-field").hidden = $("limit-value").disabled = reset;
  Object.assign($("limit-value"), { min: limit.lowest, max: limit.highest, value: limit.value ?? "" });
  $("limit-reason").value = "";
  $("limit-form").onsubmit = () => changeLimit(limit, reset ? null : Number($("limit-value").value));
  $("limit").showModal();
}

async function changeLimit(limit, value) {
  const path = `/api/ejectors/${chosen}/limits`;
  const say = (text) => { $("limits-said").textContent = text; };
  say("");
  try {
    const { request } = await post(path, { limit: limit.key, value, reason: $("limit-reason").value });
    await loadLimits();
    const why = await answered(`${path}/${request}`);
    say(why ? t("{limit}: refused. {why}", { limit: limit.title, why }) : t("{limit}: changed", { limit: limit.title }));
  } catch (error) {
    say(`${limit.title}: ${error.message}`);
  }
  loadLimits();
}

async function answered(path) {
  for (;;) {
    const { answer } = await get(path);
    if (answer !== null) return answer;
    await new Promise((done) => setTimeout(done, 1000));
  }
}

// --- live vacuum ---------------------------------------------------------------------------------

const NO_ROWS = () => ({
  time: [], host: [], phase: [], measured_low: [], measured_high: [], expected_low: [], expected_high: [],
});

const VACUUM = { // what charts of it have in common
  unit: "mbar",
  values: (low = 0, high = 0) => [Math.min(low, -20), Math.max(high * 1.05, 100)],
};

const VACUUM_SERIES = [
  { colour: "--orange", width: 3, dash: [8, 5], label: t("expected"), isRange: true },
  { colour: "--blue", width: 2, fill: "54", label: t("measured"), isRange: true, order: -1 },
];

function drawVacuum(rows) {
  const side = (name) => ({ time: rows.time, low: rows[`${name}_low`], high: rows[`${name}_high`] });
  live.chart.set([side("expected"), side("measured")]);
}

function firstAfter(times, wanted) { // index of the first one that is later; times ascend
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] > wanted) high = middle; else low = middle + 1;
  }
  return low;
}

function headPlot(said) {
  $("plot-head").textContent = states.length > 1 ? `${states[chosen].name}: ${said}` : said;
}

const phaseBand = (from, to, phase) => ({ from, to, phase, colour: PHASE_COLOURS[phase], text: PHASES[phase] });

const live = {
  chart: null,
  window: "10", // s, as it was chosen
  rows: NO_ROWS(),
  marks: new Map(), // alarms of the ejector that is shown, also those that are over

  clear() {
    this.rows = NO_ROWS();
    for (const id of ["measured", "expected", "difference", "phase"]) $(id).textContent = "–";
    this.marks = new Map();
    this.note();
    if (this.chart && !past.on) this.chart.goHome();
    this.show();
  },

  take(told) {
    told.time.forEach((time, i) => {
      const before = this.end();
      if (time <= before) this.clear(); // the PLC began anew
      if (told.broken[i] && this.rows.time.length) this.push(told, i, time - 1e-3, true);
      this.push(told, i, time, false);
    });
    const old = firstAfter(this.rows.time, this.end() - KEPT_S);
    if (old > 0) for (const column of Object.values(this.rows)) column.splice(0, old);
    this.say(told);
    this.show();
  },

  push(told, i, time, broken) {
    for (const [name, column] of Object.entries(this.rows)) {
      const isValue = name.endsWith("low") || name.endsWith("high");
      column.push(name === "time" ? time : broken && isValue ? null : told[name][i]);
    }
  },

  end() {
    const { time } = this.rows;
    return time.length ? time[time.length - 1] : -Infinity;
  },

  say(told) {
    const last = told.time.length - 1;
    if (last < 0) return;
    const middle = (side) => {
      const [low, high] = [told[`${side}_low`][last], told[`${side}_high`][last]];
      return low === null ? null : (low + high) / 2;
    };
    const [measured, expected] = [middle("measured"), middle("expected")];
    const both = measured !== null && expected !== null;
    $("measured").textContent = number(measured, 0);
    $("expected").textContent = number(expected, 0);
    $("difference").textContent = number(both ? measured - expected : null, 1);
    $("phase").textContent = PHASES[told.phase[last]];
  },

  show() {
    if (!this.chart) this.chart = new Chart($("plot"), VACUUM_SERIES, this.options());
    if (past.on) return;
    drawVacuum(this.rows);
    this.head();
  },

  options() {
    const home = () => {
      const end = this.rows.time.length ? this.end() : 0;
      return [end - Number(this.window), end];
    };
    return {
      ...VACUUM, home, least: 0.5, tools: $("plot-tools"), back: t("Back to live"),
      all: () => [Math.min(home()[0], this.rows.time[0] ?? 0), home()[1]],
      ticks: secondsBefore(() => home()[1]),
      bands: (from, to) => this.phases(from, to),
      marks: () => this.alarms(),
      moved: () => this.head(),
    };
  },

  head() {
    if (!this.chart) return;
    const [from, to] = this.chart.range().map((time) => Math.max(0, this.end() - time));
    const brief = (seconds) => number(seconds, seconds < 10 && seconds % 1 > 0.05 ? 1 : 0);
    const said = this.chart.end === null || !this.rows.time.length
      ? t("Vacuum, the last {from} s", { from: brief(this.rows.time.length ? from : Number(this.window)) })
      : t("Vacuum, {from} to {to} s ago", { from: brief(from), to: brief(to) });
    headPlot(said);
  },

  phases(from, to) {
    const { time, phase } = this.rows;
    const bands = [];
    for (let i = Math.max(0, firstAfter(time, from) - 1); i <= Math.min(firstAfter(time, to), time.length - 1); i += 1) {
      const last = bands[bands.length - 1];
      if (last) last.to = time[i];
      if (!last || last.phase !== phase[i]) {
        bands.push(phaseBand(time[i], time[i], phase[i]));
      }
    }
    return bands;
  },

  note() { // what becomes of alarms: a cause may be named later, and one that is over leaves the list
    const there = chosen === null ? [] : states[chosen].alarms.filter(({ raised }) => raised);
    for (const [raised, mark] of this.marks) {
      if (!there.some((one) => one.raised === raised)) mark.cleared ??= now();
    }
    for (const { raised, cleared, what } of there) this.marks.set(raised, { raised, cleared, what });
  },

  alarms() { // where they were raised and were over, by the clock of the run
    const { time, host } = this.rows;
    const isSeen = (at) => at && host[0] <= at && at <= host[host.length - 1];
    const mark = (at, text, dash) => ({ at: time[firstAfter(host, at)] ?? this.end(), text, colour: "--alarm", dash });
    return [...this.marks.values()].flatMap(({ raised, cleared, what }) => [
      ...(isSeen(raised) ? [mark(raised, what, [])] : []),
      ...(isSeen(cleared) ? [mark(cleared, t("{alarm}: over", { alarm: what }), [2, 4])] : []),
    ]);
  },
};

// --- vacuum of any time --------------------------------------------------------------------------

const past = { // takes the place of the live curve, by the clock of the run
  on: false,
  curve: NO_CURVE,
  preset: null, // [value of the choice, its seconds] while that is what is shown
  asked: 0,
  timer: null,

  options() {
    return {
      ...VACUUM, least: 0.5, most: LONGEST_S, leave: () => this.leave(),
      home: () => [now() - AROUND_S, now()],
      all: () => [now() - BACK_S, now()],
      ticks: dates,
      bands: () => this.bands(),
      marks: () => this.curve.alarms.flatMap(alarmMarks),
      moved: () => this.moved(),
    };
  },

  open(from, to, preset = null) {
    this.preset = preset;
    if (!this.on) {
      this.on = true;
      live.chart.use(this.options());
      this.take({ ...NO_CURVE, share: 0 });
    }
    live.chart.show(from, to);
  },

  choose(value) { // of the ranges that end now
    const then = there(now());
    const today = then.getHours() * 3600 + then.getMinutes() * 60 + then.getSeconds();
    const seconds = value === "today" ? Math.max(today, AROUND_S) : Number(value);
    this.open(now() - seconds, now(), [value, seconds]);
  },

  leave() {
    if (!this.on) return;
    this.on = false;
    this.asked += 1; // what is on its way comes too late
    clearTimeout(this.timer);
    $("window").value = live.window;
    $("curve-from").value = $("curve-to").value = "";
    this.say("");
    live.chart.use(live.options());
    live.chart.goHome();
    live.show();
  },

  get follows() { return live.chart.end === null; },

  moved() {
    const [from, to] = live.chart.range();
    const isPreset = this.preset && this.follows && Math.abs(to - from - this.preset[1]) < 1;
    $("window").value = isPreset ? this.preset[0] : "";
    fillRange("curve", [from, to]);
    this.head();
    this.fetchSoon(100);
  },

  head() {
    const [from, to] = live.chart.range().map(there);
    const time = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
    const day = { day: "numeric", month: "short" };
    const isOneDay = from.toDateString() === to.toDateString();
    const begin = from.toLocaleString(DATES, { ...day, ...time });
    headPlot(t("Vacuum, {from} to {to}", { from: begin, to: to.toLocaleString(DATES, isOneDay ? time : { ...day, ...time }) }));
  },

  fetchSoon(ms) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.fetch(), ms);
  },

  async fetch() {
    this.asked += 1;
    const turn = this.asked;
    const [from, to] = live.chart.range();
    let curve;
    try {
      curve = await get(`/api/ejectors/${chosen}/curve?from=${from}&to=${to}`);
    } catch (error) {
      curve = { ...NO_CURVE, trouble: error.message };
    }
    if (turn !== this.asked) return;
    this.take({ ...curve, range: [from, to] });
    if (curve.share < 1) this.fetchSoon(20);
    else if (this.follows) this.fetchSoon(1000 * Math.max(FOLLOW_S, (to - from) / 500));
  },

  take(curve) {
    this.curve = curve;
    drawVacuum(curve);
    this.say(this.words(curve));
    if (this.follows) this.head();
  },

  words({ share, logged, damaged, trouble }) {
    if (trouble) return trouble;
    if (share < 1) return t("Reading the logs: {percent} %", { percent: Math.round(100 * share) });
    if (damaged) return t("Part of the logs cannot be read; twin log check says where.");
    if (!logged) return t("There are no logs to look back in: twin run --log FOLDER writes them.");
    return this.follows ? "" : t("The values above are the newest.");
  },

  say(words) {
    $("curve-said").textContent = words;
    $("curve-said").hidden = !words;
    document.querySelector(".live").classList.toggle("past", this.on);
  },

  bands() {
    const gaps = this.curve.gaps.map(([from, to]) => ({ from, to, colour: "--gap", text: t("nothing recorded") }));
    return [...gaps, ...(this.curve.phases || []).map((one) => phaseBand(...one))];
  },
};

function alarmMarks({ what, raised, cleared, seen }) {
  const mark = (at, text, dash, colour = "--alarm") => (at ? [{ at, text, dash, colour }] : []);
  return [
    ...mark(raised, what, []),
    ...mark(cleared, t("{alarm}: over", { alarm: what }), [2, 4]),
    ...mark(seen, t("{alarm}: acknowledged", { alarm: what }), [8, 4], "--ink"),
  ];
}

// --- trends --------------------------------------------------------------------------------------

let trendChart = null;
let trendSpan = [0, 1]; // s
let trendAsked = 0;
let trendMarks = [];

async function showTrend() {
  if (chosen === null) return;
  const turn = ++trendAsked;
  const figure = $("figure").value;
  const days = $("trend-days").value;
  let trend;
  let raised = [];
  try {
    const ejector = `/api/ejectors/${chosen}`;
    [trend, raised] = await Promise.all(
      [get(`${ejector}/trends/${figure}?days=${days}`), get(`${ejector}/history?days=${days}`)]);
  } catch (error) {
    trend = { words: error.message, unit: "" };
  }
  if (turn !== trendAsked) return;
  const known = me.figures.find((one) => one.name === figure);
  $("trend-what").textContent = known ? known.what : "";
  $("trend-words").textContent = trend.words;
  for (const id of ["trend-plot", "trend-tools", "trend-legend", "trend-range"]) $(id).hidden = !trend.time;
  if (!trend.time) return;
  trendMarks = marksOf(trend, raised);
  drawTrend(trend);
}

function marksOf({ step }, raised) { // the step of a figure, and the newest alarms
  const alarms = raised.slice(0, MOST_MARKS).map((one) => ({ at: one.raised, text: one.what, colour: "--alarm" }));
  return step ? [{ ...step, text: t("step"), colour: "--step" }, ...alarms] : alarms;
}

function fillRange(name, [from, to]) { // as the fields of a range have it, by the server's clock
  $(`${name}-from`).value = fieldOf(from);
  $(`${name}-to`).value = fieldOf(to);
}

function rangeOf(name) { // what is typed there; null if it is none
  const [from, to] = ["from", "to"].map((end) => secondsOf($(`${name}-${end}`).value));
  return Number.isFinite(from) && Number.isFinite(to) && from < to ? [from, to] : null;
}

function fieldOf(seconds) {
  const then = there(seconds);
  const two = (value) => String(value).padStart(2, "0");
  const date = [then.getFullYear(), two(then.getMonth() + 1), two(then.getDate())].join("-");
  return `${date}T${[then.getHours(), then.getMinutes(), then.getSeconds()].map(two).join(":")}`;
}

function chooseTrendRange() {
  const range = rangeOf("trend");
  if (range) trendChart.show(...range);
  else fillRange("trend", trendChart.range());
}

function chooseCurveRange() {
  const range = rangeOf("curve");
  if (range) past.open(...range);
  else if (past.on) fillRange("curve", live.chart.range());
}

function chooseWindow() {
  const { value } = $("window");
  const isKept = Number(value) <= Math.max(RING_S, live.end() - live.rows.time[0]);
  if (Number(value) <= KEPT_S && (isKept || !states[chosen]?.logged)) {
    live.window = value;
    past.leave();
    live.chart?.goHome();
  } else if (live.chart) past.choose(value);
}

function secondsOf(field) {
  const then = new Date(field);
  return then.getTime() / 1000 - (zone === null ? 0 : zone + then.getTimezoneOffset() * 60);
}

const TREND_SERIES = [
  { colour: "--blue", fill: "40", isRange: true },
  { colour: "--grey", dots: true, label: t("measured") },
  { colour: "--orange", width: 2, dash: [8, 5], spanGaps: true, label: t("expected") },
  { colour: "--blue", width: 3, label: t("line") },
  { colour: "--red", width: 3, dash: [2, 5] },
];

function drawTrend(trend) {
  const { time } = trend;
  const line = trend.line || { time: [], middle: [], low: [], high: [] };
  const span = [...time, ...line.time];
  trendSpan = [Math.min(...span), Math.max(...span)];
  if (trendSpan[0] === trendSpan[1]) trendSpan = [trendSpan[0] - 30, trendSpan[1] + 30];
  const limit = trend.limit ?? null;
  if (!trendChart) {
    trendChart = new Chart($("trend-plot"), TREND_SERIES, {
      home: () => trendSpan, all: () => trendSpan, least: 10, tools: $("trend-tools"),
      values: (low = 0, high = 1) => roomy(low, high), ticks: dates,
      marks: () => trendMarks, moved: () => trendChart && fillRange("trend", trendChart.range()),
    });
  }
  trendChart.options.unit = trend.unit;
  trendChart.set([
    { time: line.time, low: line.low, high: line.high },
    { time, low: trend.measured },
    { time, low: trend.expected },
    { time: line.time, low: line.middle },
    limit === null ? { time: [], low: [] } : { time: trendSpan, low: [limit, limit] },
  ]);
  trendChart.goHome();
}

// --- history -------------------------------------------------------------------------------------

let episodes = [];

async function loadHistory() {
  if (chosen === null) return;
  try {
    const days = $("history-days").value;
    const [known, figures] = await Promise.all(
      [get(`/api/ejectors/${chosen}/history?days=${days}`), get(`/api/statistics?days=${days}`)]);
    episodes = known;
    $("statistics-rows").replaceChildren(rows(figures));
    showHistory();
  } catch (error) {
    $("episodes").replaceChildren(element("p", { class: "nothing" }, error.message));
  }
}

function showHistory() {
  const wanted = $("search").value.trim().toLowerCase();
  const priority = $("priority").value;
  const shown = episodes.filter((one) => (!priority || one.priority === priority)
    && (!wanted || JSON.stringify(one).toLowerCase().includes(wanted)));
  $("episodes").replaceChildren(...(shown.length ? shown.map(episodeCard)
    : [element("p", { class: "nothing" }, t("No alarm in that time is like that."))]));
}

function episodeCard(one) {
  const end = one.cleared ? t("{time}, after {lasted}", { time: one.times.cleared, lasted: one.times.lasted })
    : t("still active");
  const seen = one.seen ? t("{time} by {who}", { time: one.times.seen, who: one.seen_by }) : t("not yet");
  return element("article", { class: "episode" },
    element("div", { class: "top" }, element("h3", {}, one.what),
      element("span", { class: "chip" }, one.priority_words)),
    rows([[t("raised"), one.times.raised], [t("ended"), end], [t("acknowledged"), seen], ...one.facts]),
    ...comments(one),
    element("div", { class: "deeds" }, reportButton(chosen, one), curveButton({ ...one, of: chosen })));
}

// --- the connection ------------------------------------------------------------------------------

let socket = null;
let heardMs = 0;

let watched = 0; // the ejector of which the server sends rows; at first the first one

function watch() {
  if (chosen === null || chosen === watched || socket.readyState !== WebSocket.OPEN) return;
  watched = chosen;
  socket.send(String(chosen));
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.addEventListener("open", () => {
    watched = 0;
    watch();
  });
  socket.addEventListener("message", (event) => hear(JSON.parse(event.data)));
  socket.addEventListener("close", (event) => {
    if (event.code === 1008) begin().catch(() => {}); // the session may be over
    setTimeout(connect, 2000);
  });
}

function hear(told) {
  heardMs = performance.now();
  if (told.states) {
    states = told.states;
    skew = states[0].now - Date.now() / 1000;
    zone = states[0].zone;
    offerEjectors();
    if (chosen === null) choose(worstFirst()[0]);
    live.note();
    announce();
    showStates();
  }
  if (told.rows && told.of === chosen) live.take(told.rows);
  showConnection();
}

let announced = null; // alarms that were there before

function announce() { // to who hears the page: alarms that are new
  const active = states.flatMap((state, of) => state.alarms.filter((one) => one.state === "unacknowledged")
    .map((one) => [`${of} ${one.raised}`, `${state.name}: ${one.what}`]));
  const fresh = announced ? active.filter(([key]) => !announced.has(key)).map(([, text]) => text) : [];
  announced = new Set(active.map(([key]) => key));
  if (fresh.length) $("news").textContent = t("New alarm: {alarms}", { alarms: fresh.join("; ") });
}

function showStates() {
  if (!states.length) return;
  showLights();
  showBanner();
  showAlarms();
}

function showConnection() {
  const silent = performance.now() - heardMs > SILENT_MS;
  const said = silent ? t("No connection to the page: nothing here is up to date") : t("connected");
  $("connection").classList.toggle("bad", silent);
  if ($("connection").textContent !== said) $("connection").textContent = said;
  if (silent && states.length) {
    states = states.map((one) => ({ ...one, light: "grey", words: t("No connection") }));
    showLights();
  }
}

// --- the beginning -------------------------------------------------------------------------------

const TABS = ["now", "trends", "history", "limits"];

function showTab(name) {
  for (const one of TABS) {
    $(one).hidden = one !== name;
    $(`tab-${one}`).setAttribute("aria-selected", String(one === name));
    $(`tab-${one}`).tabIndex = one === name ? 0 : -1;
  }
  if (name === "trends") showTrend();
  if (name === "history") loadHistory();
  if (name === "limits") loadLimits();
}

async function begin() {
  me = await get("/api/me");
  $("who").textContent = me.user;
  offerLanguages(me.languages);
  $("all").hidden = !me.all;
  $("login").hidden = Boolean(me.user);
  $("logout").hidden = !me.user;
  if (!$("figure").children.length) {
    $("figure").replaceChildren(...me.figures.map((one) => element("option", { value: one.name },
      one.title)));
    $("figure").value = "leakage";
  }
  showStates();
}

function moveTab(event, at) { // as tabs go by keyboard
  const to = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: TABS.length - 1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  const name = TABS[(to + TABS.length) % TABS.length];
  showTab(name);
  $(`tab-${name}`).focus();
}

function listen() {
  TABS.forEach((name, at) => {
    $(`tab-${name}`).addEventListener("click", () => showTab(name));
    $(`tab-${name}`).addEventListener("keydown", (event) => moveTab(event, at));
  });
  $("window").addEventListener("change", chooseWindow);
  for (const id of ["curve-from", "curve-to"]) $(id).addEventListener("change", chooseCurveRange);
  $("whose").addEventListener("change", () => ($("whose").value ? choose(Number($("whose").value)) : showStates()));
  for (const id of ["trend-from", "trend-to"]) $(id).addEventListener("change", chooseTrendRange);
  $("comment-cancel").addEventListener("click", () => $("comment").close());
  $("limit-cancel").addEventListener("click", () => $("limit").close());
  $("report-close").addEventListener("click", () => $("report").close());
  $("which").addEventListener("change", showAlarms);
  $("figure").addEventListener("change", showTrend);
  $("trend-days").addEventListener("change", showTrend);
  $("history-days").addEventListener("change", loadHistory);
  $("search").addEventListener("input", showHistory);
  $("priority").addEventListener("change", showHistory);
  $("shelve-cancel").addEventListener("click", () => $("shelve").close());
  $("logout").addEventListener("click", async () => { await post("/api/logout", {}); location.reload(); });
  setInterval(showConnection, 1000);
  setInterval(loadLimits, LIMITS_MS);
}

listen();
begin().then(connect, (error) => { $("connection").textContent = error.message; });
