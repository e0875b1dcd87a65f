// The technician's page. What comes from the server is put in as text, never as markup.
"use strict";

const PHASES = ["idle", "suction", "hold", "blow-off"];
const PHASE_COLOURS = ["--idle", "--suction", "--hold", "--blow"];
const DEEDS = {
  acknowledged: "Acknowledge", shelved: "Keep quiet", unshelved: "Let it speak",
  out_of_service: "Take out of service", in_service: "Back into service",
};
const TIMES = [[900, "15 minutes"], [3600, "1 hour"], [4 * 3600, "4 hours"], [8 * 3600, "8 hours"]];
const WINDOW_S = 10;
const SHOWN = ["size", "how sure"]; // of what speaks for an alarm, at first sight
const QUIET = ["shelved", "suppressed", "out_of_service"];

let me = { user: "", csrf: "", ejectors: [], figures: [] };
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
  return element("div", { class: "deeds" }, ...possible.map((deed) => element(
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
    choice("Until it is taken into service again", "out_of_service", 0));
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

const live = {
  plot: null,
  data: [[], [], [], [], []], // time, measured low and high, expected low and high
  phases: [],

  clear() {
    this.data = [[], [], [], [], []];
    this.phases = [];
    for (const id of ["measured", "expected", "difference", "phase"]) $(id).textContent = "–";
    if (this.plot) this.plot.setData(this.data);
  },

  take(rows) {
    const [time] = this.data;
    const names = ["time", "measured_low", "measured_high", "expected_low", "expected_high"];
    rows.time.forEach((t, i) => {
      if (time.length && t <= time[time.length - 1]) this.clear(); // the PLC began anew
      if (rows.broken[i] && this.data[0].length) this.push([t - 1e-3, null, null, null, null], 0);
      this.push(names.map((name) => rows[name][i]), rows.phase[i]);
    });
    this.forget();
    this.show(rows);
  },

  push(values, phase) {
    values.forEach((value, i) => this.data[i].push(value));
    this.phases.push(phase);
  },

  forget() {
    const [time] = this.data;
    const first = time.findIndex((t) => t >= time[time.length - 1] - WINDOW_S - 0.5);
    if (first > 0) for (const column of [...this.data, this.phases]) column.splice(0, first);
  },

  show(rows) {
    const last = rows.time.length - 1;
    if (last >= 0) {
      const middle = (side) => {
        const [low, high] = [rows[`${side}_low`][last], rows[`${side}_high`][last]];
        return low === null ? null : (low + high) / 2;
      };
      const [measured, expected] = [middle("measured"), middle("expected")];
      const both = measured !== null && expected !== null;
      $("measured").textContent = number(measured, 0);
      $("expected").textContent = number(expected, 0);
      $("difference").textContent = number(both ? measured - expected : null, 1);
      $("phase").textContent = PHASES[rows.phase[last]];
    }
    if (!this.plot) this.draw();
    else this.plot.setData(this.data);
  },

  draw() {
    if (this.plot) this.plot.destroy();
    const box = $("plot");
    const side = (name, width, dash) => ({
      stroke: colour(name), width, dash, points: { show: false },
    });
    this.plot = new uPlot({
      width: box.clientWidth, height: box.clientHeight,
      legend: { show: false }, cursor: { show: false },
      scales: {
        x: { time: false, range: () => this.range() },
        y: { range: (_plot, low, high) => [Math.min(low ?? 0, -20), Math.max((high ?? 0) * 1.05, 100)] },
      },
      axes: [
        axis({ values: (_plot, ticks) => ticks.map((t) => `${Math.round(t - this.range()[1])} s`),
          splits: () => [-10, -8, -6, -4, -2, 0].map((s) => this.range()[1] + s) }),
        axis({ size: 60 }),
      ],
      series: [{}, side("--orange", 3, [8, 5]), side("--orange", 3, [8, 5]),
        side("--blue", 2), side("--blue", 2)],
      bands: [{ series: [4, 3], fill: colour("--blue") + "55" }],
      hooks: { drawClear: [(plot) => this.drawPhases(plot)] },
    }, this.ordered(), box);
    const plain = this.plot.setData.bind(this.plot);
    this.plot.setData = () => plain(this.ordered());
  },

  ordered() { // expected below, measured above
    const [time, low, high, expectedLow, expectedHigh] = this.data;
    return [time, expectedLow, expectedHigh, low, high];
  },

  range() {
    const [time] = this.data;
    const end = time.length ? time[time.length - 1] : 0;
    return [end - WINDOW_S, end];
  },

  drawPhases(plot) {
    const [time] = this.data;
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (let from = 0; from < time.length;) {
      let to = from;
      while (to + 1 < time.length && this.phases[to + 1] === this.phases[from]) to += 1;
      const left = plot.valToPos(time[from], "x", true);
      const right = plot.valToPos(time[Math.min(to + 1, time.length - 1)], "x", true);
      ctx.fillStyle = colour(PHASE_COLOURS[this.phases[from]]);
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
      from = to + 1;
    }
    ctx.restore();
  },
};

// --- trends --------------------------------------------------------------------------------------

let trendPlot = null;
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
  if (trendPlot) trendPlot.destroy();
  trendPlot = null;
  $("trend-plot").hidden = $("trend-legend").hidden = !trend.time;
  if (trend.time) drawTrend(trend);
}

function drawTrend(trend) {
  const line = trend.line || { time: [], middle: [], low: [], high: [] };
  const fill = (times, value) => [times, times.map(() => value)];
  const span = [...trend.time, ...line.time];
  const ends = [Math.min(...span), Math.max(...span)];
  const tables = [[trend.time, trend.measured, trend.expected],
    [line.time, line.high, line.low, line.middle]];
  if (trend.limit !== null && trend.limit !== undefined) tables.push(fill(ends, trend.limit));
  const data = uPlot.join(tables, tables.map((table) => table.slice(1).map(() => 2)));
  const bare = { width: 0, points: { show: false } };
  const series = [
    {},
    { stroke: colour("--grey"), paths: () => null,
      points: { show: true, size: 5, fill: colour("--grey"), width: 0 } },
    { stroke: colour("--orange"), width: 2, dash: [8, 5], points: { show: false }, spanGaps: true },
    { ...bare, stroke: colour("--blue"), spanGaps: true },
    { ...bare, stroke: colour("--blue"), spanGaps: true },
    { stroke: colour("--blue"), width: 3, points: { show: false }, spanGaps: true },
    { stroke: colour("--red"), width: 3, dash: [2, 5], points: { show: false }, spanGaps: true },
  ];
  const box = $("trend-plot");
  trendPlot = new uPlot({
    width: box.clientWidth - 18, height: box.clientHeight - 18,
    legend: { show: false }, cursor: { show: false }, tzDate: there,
    scales: { y: { range: (_plot, low, high) => trendRange(low, high) } },
    axes: [axis({ space: 90, values: (_plot, ticks) => dates(ticks) }), axis({ size: 70, label: trend.unit, labelFont: "15px system-ui" })],
    series: series.slice(0, data.length),
    bands: [{ series: [3, 4], fill: colour("--blue") + "40" }],
  }, data, box);
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
  if (name === "now") resize();
  if (name === "trends") showTrend();
  if (name === "history") loadHistory();
}

function resize() {
  const box = $("plot");
  if (live.plot && box.clientWidth) live.plot.setSize({ width: box.clientWidth, height: box.clientHeight });
  const trend = $("trend-plot");
  if (trendPlot && trend.clientWidth) {
    trendPlot.setSize({ width: trend.clientWidth - 18, height: trend.clientHeight - 18 });
  }
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
  addEventListener("resize", resize);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    if (live.plot) live.draw();
    if (!$("trends").hidden) showTrend();
  });
  setInterval(showConnection, 1000);
}

listen();
begin().then(connect, (error) => { $("connection").textContent = error.message; });
