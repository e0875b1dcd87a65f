// The technician's page. What comes from the server is put in as text, never as markup.
"use strict";

const PHASES = ["idle", "suction", "hold", "blow-off"];
const PHASE_COLOURS = ["--idle", "--suction", "--hold", "--blow"];
const DEEDS = {
  acknowledged: "Acknowledge", shelved: "Keep quiet", unshelved: "Let it speak",
  out_of_service: "Take out of service", in_service: "Back into service",
};
const TIMES = [[900, "15 minutes"], [3600, "1 hour"], [4 * 3600, "4 hours"], [8 * 3600, "8 hours"]];
const WINDOW_S = 10; // of live rows, at first
const KEPT_S = 300; // of them, to look back at
const SHOWN = ["size", "how sure"]; // of what speaks for an alarm, at first sight
const QUIET = ["shelved", "suppressed", "out_of_service"];

let me = { user: "", csrf: "", may: [], ejectors: [], figures: [] };
let states = [];
let chosen = 0;
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
  const quiet = state.alarms.length - standing;
  const parts = [];
  if (!state.running) parts.push(state.last ? `since ${state.last_seen}` : "never yet");
  if (standing) parts.push(standing === 1 ? "1 alarm" : `${standing} alarms`);
  if (quiet) parts.push(`${quiet} kept quiet`);
  return parts.join(", ") || "no alarm";
}

function showLights() {
  const old = $("ejectors");
  const focused = [...old.children].indexOf(document.activeElement);
  const lights = states.map((state, number) => element(
    "button",
    {
      type: "button", class: `ejector ${state.light}`, "aria-pressed": String(number === chosen),
      "data-light": state.light, onclick: () => choose(number),
    },
    icon(state.light),
    element("b", {}, state.words),
    element("span", {}, `${state.name}: ${summary(state)}`),
  ));
  const key = lights.map((one) => one.outerHTML).join("");
  if (old.dataset.key === key) return;
  old.dataset.key = key;
  old.replaceChildren(...lights);
  if (focused >= 0 && lights[focused]) lights[focused].focus();
  document.title = `${states.map((one) => one.words).join(" / ")} – ejectors`;
}

function choose(number) {
  chosen = number;
  live.clear();
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(String(number));
  showStates();
  if (!$("trends").hidden) showTrend();
  if (!$("history").hidden) loadHistory();
}

function showBanner() {
  const state = states[chosen];
  const said = [];
  if (!state.running) {
    const how = state.ended ? "twin run has ended" : "twin run does not answer";
    said.push(state.last ? `Not running since ${state.last_seen}: ${how}. What follows is as it was then.`
      : "Not running: twin run has not been started yet.");
  }
  if (state.trouble) said.push(state.trouble);
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

function showAlarms() {
  const state = states[chosen];
  const shown = state.alarms.filter(isShown);
  $("count").textContent = state.alarms.length ? `(${state.alarms.length})` : "";
  const box = $("alarms");
  const ageless = (name, value) => (["times", "quiet_until"].includes(name) ? undefined : value);
  const key = JSON.stringify([chosen, me.user, shown, [...mine]], ageless);
  if (box.dataset.key !== key) {
    const open = new Set([...box.querySelectorAll("details[open]")].map((one) => one.dataset.alarm));
    const focused = document.activeElement && document.activeElement.dataset.focus;
    box.dataset.key = key;
    box.replaceChildren(...(shown.length ? shown.map((one) => alarmCard(one, open)) : [nothing(state)]));
    const again = focused && box.querySelector(`[data-focus="${CSS.escape(focused)}"]`);
    if (again) again.focus();
  }
  for (const one of box.querySelectorAll("[data-since]")) {
    one.textContent = since(shown.find((alarm) => alarm.alarm === one.dataset.since));
  }
}

function since(alarm) {
  const { raised, cleared, seen } = alarm.times || {};
  const said = raised ? [`since ${raised}`] : [];
  if (cleared) said.push(`gone since ${cleared}`);
  if (seen) said.push(`acknowledged ${seen} by ${alarm.seen_by}`);
  if (alarm.quiet_until) said.push(`quiet until ${alarm.quiet_until}`);
  return said.join("; ");
}

function nothing(state) {
  const none = state.alarms.length ? "No alarm is like that." : "No alarm stands.";
  const unknown = state.trouble || state.last === null;
  return element("p", { class: "nothing" }, unknown ? "The alarms are not known." : none);
}

function alarmCard(alarm, open) {
  const where = [states[chosen].name, alarm.where].filter(Boolean).join(": ");
  return element(
    "article", { class: `alarm ${alarm.state} ${alarm.priority}`, "data-alarm": alarm.alarm },
    element("div", { class: "top" }, element("h3", {}, alarm.what),
      element("span", { class: "chip" }, `${alarm.priority} priority`),
      element("span", { class: "chip state" }, STATES[alarm.state])),
    element("p", { class: "since", "data-since": alarm.alarm }),
    element("p", { class: "todo" }, alarm.action),
    rows([["where", where], ...alarm.facts.filter(([name]) => SHOWN.includes(name))]),
    evidence(alarm, open),
    deeds(alarm),
    ...asked(alarm),
  );
}

function evidence(alarm, open) {
  const facts = alarm.facts.filter(([name]) => !SHOWN.includes(name));
  return element(
    "details", { "data-alarm": alarm.alarm, open: open.has(alarm.alarm) },
    element("summary", { "data-focus": `why ${alarm.alarm}` }, "Evidence"),
    rows([["what it is", alarm.sentence], ["if nobody acts", alarm.consequence], ...facts, ["alarm", alarm.alarm]]));
}

function reportLink(one) {
  if (!one.report) return null;
  const href = `/reports/${chosen}/${one.report}`;
  return element("a", { class: "button", href, target: "_blank", rel: "noopener" },
    "See diagnosis");
}

function deeds(alarm) {
  const possible = [];
  if (!alarm.acknowledged) possible.push("acknowledged");
  if (alarm.state === "shelved") possible.push("unshelved");
  else if (alarm.state === "out_of_service") possible.push("in_service");
  else possible.push("shelved");
  if (!me.user) {
    return element("div", { class: "deeds" },
      element("a", { class: "button", href: "/login" }, "Log in to acknowledge"), reportLink(alarm));
  }
  const allowed = possible.filter((deed) => me.may.includes(deed));
  if (!me.may.length) {
    return element("div", { class: "deeds" },
      element("span", {}, `${me.user} may look, and acknowledges nothing`), reportLink(alarm));
  }
  return element("div", { class: "deeds" }, ...allowed.map((deed) => element(
    "button", {
      type: "button", class: deed === "acknowledged" ? "first" : false,
      "data-focus": `${deed} ${alarm.alarm}`,
      disabled: alarm.asked.some((one) => one.deed === deed),
      onclick: () => (deed === "shelved" ? offerTimes(alarm) : ask(alarm, deed)),
    }, deed === "shelved" ? `${DEEDS[deed]} …` : DEEDS[deed])), reportLink(alarm));
}

function asked(alarm) {
  const waits = states[chosen].running ? "asked, a moment …" : "asked; waits for the next run";
  const said = alarm.asked.map((one) => element(
    "p", { class: "asked", role: "status" }, `${DEEDS[one.deed]}: ${waits} (${one.who})`));
  const own = mine.get(`${chosen} ${alarm.alarm}`);
  if (own) said.push(element("p", { class: "asked refused", role: "alert" }, own));
  return said;
}

function offerTimes(alarm) {
  $("shelve-what").textContent = `${alarm.what} says nothing for a time; then it speaks again by itself.`;
  const times = TIMES.filter(([seconds]) => seconds <= alarm.longest_shelving_s);
  const choice = (text, deed, seconds) => element("button", {
    type: "button", onclick: () => { $("shelve").close(); ask(alarm, deed, seconds); },
  }, text);
  $("shelve-times").replaceChildren(
    ...times.map(([seconds, text]) => choice(text, "shelved", seconds)),
    ...(me.may.includes("out_of_service")
      ? [choice("Until it is taken into service again", "out_of_service", 0)] : []));
  $("shelve").showModal();
}

async function ask(alarm, deed, seconds = 0) {
  const number = chosen;
  const key = `${number} ${alarm.alarm}`;
  const path = `/api/ejectors/${number}/requests`;
  mine.delete(key);
  try {
    const { request } = await post(path, { alarm: alarm.alarm, deed, seconds });
    alarm.asked.push({ deed, who: me.user });
    showAlarms();
    const why = await answered(`${path}/${request}`);
    if (why) mine.set(key, `${DEEDS[deed]}: refused. ${why}`);
  } catch (error) {
    mine.set(key, `${DEEDS[deed]}: ${error.message}`);
  }
  showAlarms();
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

const live = {
  chart: null,
  rows: NO_ROWS(),

  clear() {
    this.rows = NO_ROWS();
    for (const id of ["measured", "expected", "difference", "phase"]) $(id).textContent = "–";
    if (this.chart) this.chart.goHome();
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
    const { time } = this.rows;
    const side = (name) => ({ time, low: this.rows[`${name}_low`], high: this.rows[`${name}_high`] });
    if (!this.chart) this.begin();
    this.chart.set([
      { ...side("expected"), colour: "--orange", width: 3, dash: [8, 5] },
      { ...side("measured"), colour: "--blue", width: 2, fill: 0.33 },
    ]);
    this.head();
  },

  begin() {
    const home = () => {
      const end = this.rows.time.length ? this.end() : 0;
      return [end - WINDOW_S, end];
    };
    this.chart = new Chart($("plot"), {
      home, least: 0.5, unit: "mbar", tools: $("plot-tools"), back: "Back to live",
      all: () => [Math.min(home()[0], this.rows.time[0] ?? 0), home()[1]],
      values: (low = 0, high = 0) => [Math.min(low, -20), Math.max(high * 1.05, 100)],
      ticks: () => secondTicks(home()[1]),
      bands: (from, to) => this.phases(from, to),
      marks: () => this.alarms(),
      moved: () => this.head(),
    });
  },

  head() {
    if (!this.chart) return;
    const [from, to] = this.chart.range().map((time) => Math.max(0, this.end() - time));
    const brief = (seconds) => number(seconds, seconds < 10 && seconds % 1 > 0.05 ? 1 : 0);
    $("plot-head").textContent = this.chart.end === null || !this.rows.time.length
      ? `Vacuum, the last ${brief(this.rows.time.length ? from : WINDOW_S)} s`
      : `Vacuum, ${brief(from)} to ${brief(to)} s ago`;
  },

  phases(from, to) {
    const { time, phase } = this.rows;
    const [first, end] = part(this.rows, from, to);
    const bands = [];
    for (let i = first; i < end; i += 1) {
      const last = bands[bands.length - 1];
      if (last) last.to = time[i];
      if (!last || last.phase !== phase[i]) {
        bands.push({ phase: phase[i], colour: PHASE_COLOURS[phase[i]], from: time[i], to: time[i] });
      }
    }
    return bands;
  },

  alarms() { // where they were raised, by the clock of the run
    const { time, host } = this.rows;
    const isSeen = ({ raised }) => raised && host[0] <= raised && raised <= host[host.length - 1];
    return (states[chosen] ? states[chosen].alarms : []).filter(isSeen).map(({ raised, what }) => (
      { at: time[firstAfter(host, raised)] ?? this.end(), text: what, colour: "--alarm" }));
  },
};

// --- trends --------------------------------------------------------------------------------------

let trendChart = null;
let trendSpan = [0, 1]; // s
let trendAsked = 0;

async function showTrend() {
  const turn = ++trendAsked;
  const figure = $("figure").value;
  const days = $("trend-days").value;
  let trend;
  try {
    trend = await get(`/api/ejectors/${chosen}/trends/${figure}?days=${days}`);
  } catch (error) {
    trend = { words: error.message, unit: "" };
  }
  if (turn !== trendAsked) return;
  const known = me.figures.find((one) => one.name === figure);
  $("trend-what").textContent = known ? known.what : "";
  $("trend-words").textContent = trend.words;
  $("trend-plot").hidden = $("trend-tools").hidden = $("trend-legend").hidden = !trend.time;
  if (trend.time) drawTrend(trend);
}

function drawTrend(trend) {
  const { time } = trend;
  const line = trend.line || { time: [], middle: [], low: [], high: [] };
  const span = [...time, ...line.time];
  trendSpan = [Math.min(...span), Math.max(...span)];
  if (trendSpan[0] === trendSpan[1]) trendSpan = [trendSpan[0] - 30, trendSpan[1] + 30];
  const known = trend.expected.map((_, i) => i).filter((i) => trend.expected[i] !== null);
  const limit = trend.limit ?? null;
  if (!trendChart) {
    trendChart = new Chart($("trend-plot"), {
      home: () => trendSpan, all: () => trendSpan, least: 10, tools: $("trend-tools"),
      values: (low = 0, high = 1) => roomy(low, high), ticks: () => dateTicks,
    });
  }
  trendChart.options.unit = trend.unit;
  trendChart.set([
    { time: line.time, low: line.low, high: line.high, colour: "--blue", fill: 0.25 },
    { time, low: trend.measured, colour: "--grey", dots: true },
    { time: known.map((i) => time[i]), low: known.map((i) => trend.expected[i]), colour: "--orange", width: 2, dash: [8, 5] },
    { time: line.time, low: line.middle, colour: "--blue", width: 3 },
    { time: limit === null ? [] : trendSpan, low: [limit, limit], colour: "--red", width: 3, dash: [2, 5] },
  ]);
  trendChart.goHome();
}

// --- history -------------------------------------------------------------------------------------

let episodes = [];

async function loadHistory() {
  try {
    episodes = await get(`/api/ejectors/${chosen}/history?days=${$("history-days").value}`);
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
    : [element("p", { class: "nothing" }, "No alarm in that time is like that.")]));
}

function episodeCard(one) {
  const end = one.cleared ? `${one.times.cleared}, after ${one.times.lasted}` : "still active";
  const seen = one.seen ? `${one.times.seen} by ${one.seen_by}` : "not yet";
  return element("article", { class: "episode" },
    element("div", { class: "top" }, element("h3", {}, one.what),
      element("span", { class: "chip" }, `${one.priority} priority`)),
    rows([["raised", one.times.raised], ["ended", end], ["acknowledged", seen], ...one.facts]),
    reportLink(one));
}

// --- the connection ------------------------------------------------------------------------------

let socket = null;
let heardMs = 0;

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.addEventListener("open", () => socket.send(String(chosen)));
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
    showStates();
  }
  if (told.rows && told.of === chosen) live.take(told.rows);
  showConnection();
}

function showStates() {
  if (!states.length) return;
  showLights();
  showBanner();
  showAlarms();
}

function showConnection() {
  const silent = performance.now() - heardMs > SILENT_MS;
  const said = silent ? "No connection to the page: nothing here is up to date" : "connected";
  $("connection").classList.toggle("bad", silent);
  if ($("connection").textContent !== said) $("connection").textContent = said;
  if (silent && states.length) {
    states = states.map((one) => ({ ...one, light: "grey", words: "No connection" }));
    showLights();
  }
}

// --- the beginning -------------------------------------------------------------------------------

function showTab(name) {
  for (const one of ["now", "trends", "history"]) {
    $(one).hidden = one !== name;
    $(`tab-${one}`).setAttribute("aria-selected", String(one === name));
  }
  if (name === "trends") showTrend();
  if (name === "history") loadHistory();
}

async function begin() {
  me = await get("/api/me");
  $("who").textContent = me.user;
  $("all").hidden = !me.all;
  $("login").hidden = Boolean(me.user);
  $("logout").hidden = !me.user;
  if (!$("figure").children.length) {
    $("figure").replaceChildren(...me.figures.map((one) => element("option", { value: one.name },
      one.name.replaceAll("_", " "))));
    $("figure").value = "leakage";
  }
  showStates();
}

function listen() {
  for (const name of ["now", "trends", "history"]) {
    $(`tab-${name}`).addEventListener("click", () => showTab(name));
  }
  $("which").addEventListener("change", showAlarms);
  $("figure").addEventListener("change", showTrend);
  $("trend-days").addEventListener("change", showTrend);
  $("history-days").addEventListener("change", loadHistory);
  $("search").addEventListener("input", showHistory);
  $("priority").addEventListener("change", showHistory);
  $("shelve-cancel").addEventListener("click", () => $("shelve").close());
  $("logout").addEventListener("click", async () => { await post("/api/logout", {}); location.reload(); });
  setInterval(showConnection, 1000);
}

listen();
begin().then(connect, (error) => { $("connection").textContent = error.message; });
