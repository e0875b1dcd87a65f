// The page over all ejectors of a broker. What comes from the server is put in as text.
"use strict";

const LOOK_MS = 2000;
const LIGHTS = {
  red: t("with an alarm"), grey: t("not known"), yellow: t("to be looked after"), green: t("all right"),
};

let me = { user: "", csrf: "" };
let told = null; // what the server said last
let heardMs = 0;
let one = null; // the ejector that is shown by itself
const plots = { one: null, figure: null };

// --- the table -----------------------------------------------------------------------------------

function hrefOf(ejector) {
  return `#${encodeURIComponent(ejector.type)}/${encodeURIComponent(ejector.id)}`;
}

function isWanted(ejector) {
  const words = $("search").value.trim().toLowerCase().split(/\s+/);
  const { type, id, batch, words: light, what } = ejector;
  const text = [type, id, batch, light, what].join(" ").toLowerCase();
  return words.every((word) => text.includes(word));
}

function showList() {
  const shown = told.ejectors.filter(isWanted);
  const box = $("all-rows");
  const focused = document.activeElement && document.activeElement.getAttribute("href");
  box.replaceChildren(...shown.map(line));
  const again = focused && box.querySelector(`a[href="${CSS.escape(focused)}"]`);
  if (again) again.focus({ preventScroll: true });
  $("counts").textContent = Object.entries(LIGHTS).filter(([light]) => told.counts[light])
    .map(([light, words]) => `${told.counts[light]} ${words}`).join(", ");
  $("none").hidden = shown.length > 0;
  $("none").textContent = told.ejectors.length ? t("No ejector is like that.")
    : t("No ejector has published anything to this broker yet.");
}

function line(ejector) {
  const name = element("a", { href: hrefOf(ejector) }, ejector.name);
  const batch = ejector.batch ? `, ${t("batch")} ${ejector.batch}` : "";
  const row = element("tr", { class: ejector.light, "data-light": ejector.light, "data-name": ejector.name },
    element("td", { class: "light" }, icon(ejector.light), element("b", {}, ejector.words)),
    element("th", { scope: "row" }, name, element("span", { class: "dim" }, ejector.type + batch)),
    element("td", {}, ...what(ejector)),
    element("td", {}, head(t("Last seen")), ...seen(ejector)),
    element("td", { class: "figures" }, head(t("Key figures (expected)")), ...ejector.figures.map(figure)),
    element("td", { class: "spark" }, spark(ejector.spark)));
  row.addEventListener("click", () => { location.hash = hrefOf(ejector); });
  return row;
}

function head(text) { // of a cell where the table's own heads are not shown
  return element("span", { class: "dim head" }, text);
}

function what(ejector) {
  const others = ejector.alarms_count - 1;
  const more = others > 0 ? " " + t("and {count} more", { count: others }) : "";
  const since = ejector.since ? t("since {time}", { time: ejector.times.since }) : "";
  return [element("b", {}, ejector.what + more),
    element("span", { class: "dim" }, since)];
}

function seen(ejector) {
  const behind = ejector.behind ? t("values {time} behind", { time: ejector.times.behind }) : "";
  return [element("span", {}, ejector.times.seen || t("never")), element("span", { class: "dim" }, behind)];
}

function figure({ title, unit, measured, expected }) {
  const beside = expected === null ? "" : ` (${brief(expected)})`;
  return element("span", {}, `${title} ${brief(measured)}${beside} ${unit}`);
}

function brief(value) {
  if (value === null) return "–";
  return number(value, Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 1 ? 1 : 3);
}

function spark({ low, high }) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 120 40");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("role", "img");
  const there = high.filter((value) => value !== null);
  const top = Math.max(100, ...there);
  const last = there.length ? there[there.length - 1] : null;
  svg.setAttribute("aria-label", last === null ? t("no vacuum yet")
    : t("vacuum up to {value} mbar", { value: Math.max(...there) }));
  const x = (i) => (120 * i) / Math.max(1, high.length - 1);
  const y = (value) => 39 - (38 * Math.max(0, value)) / top;
  let d = "";
  high.forEach((value, i) => {
    if (value === null || low[i] === null) return;
    const gap = i === 0 || high[i - 1] === null;
    d += `${gap ? "M" : "L"}${x(i).toFixed(1)} ${y(value).toFixed(1)}L${x(i).toFixed(1)} ${y(low[i]).toFixed(1)}`;
  });
  const path = document.createElementNS(space, "path");
  path.setAttribute("d", d);
  svg.append(path);
  return svg;
}

// --- one by itself -------------------------------------------------------------------------------

function showOne() {
  $("one-name").textContent = `${one.type} ${one.id}`;
  const light = $("one-light");
  light.className = `ejector ${one.light}`;
  light.dataset.light = one.light;
  const since = one.since ? t("since {time}", { time: one.times.since }) : "";
  light.replaceChildren(icon(one.light), element("b", {}, one.words), element("span", {}, since));
  $("one-alarms").replaceChildren(...(one.alarms.length ? one.alarms.map(card)
    : [element("p", { class: "nothing" }, t("No alarm stands."))]));
  const known = [[t("batch"), one.batch], [t("last seen"), one.times.seen || t("never")],
    [t("twin"), one.status], [t("program"), one.program]];
  $("one-facts").replaceChildren(...rows(known).childNodes);
  showPlots();
}

function card(alarm) {
  const since = alarm.since ? t("since {time}", { time: alarm.times.since }) : "";
  return element("article", { class: `alarm ${alarm.state} ${alarm.priority}`, "data-alarm": alarm.alarm },
    element("div", { class: "top" }, element("h3", {}, alarm.what),
      element("span", { class: "chip" }, alarm.priority_words),
      element("span", { class: "chip state" }, alarm.state_words)),
    element("p", { class: "since" }, since),
    element("p", { class: "todo" }, alarm.action),
    rows([[t("where"), alarm.where], ...alarm.facts, [t("if nobody acts"), alarm.consequence]]));
}

function showPlots() {
  const { time, low, high, expected } = one.rows;
  draw("one", "mbar", [{ time, low: expected }, { time, low, high }]);
  const select = $("figure");
  const names = one.trends.map((trend) => trend.name);
  if ([...select.options].map((option) => option.value).join() !== names.join()) {
    const before = select.value;
    select.replaceChildren(...names.map((name) => element("option", { value: name }, one.trends.find((trend) => trend.name === name).title)));
    select.value = names.includes(before) ? before : names[0] || "";
  }
  const trend = one.trends.find((each) => each.name === select.value);
  $("figure-what").textContent = trend ? `${trend.what}, ${trend.unit}` : t("No cycle has been reported yet.");
  const { time: at, measured, expected: beside, unit } = trend || { time: [], measured: [], expected: [], unit: "" };
  draw("figure", unit, [{ time: at, low: measured }, { time: at, low: beside }]);
}

const EXPECTED = { colour: "--orange", width: 2, dash: [8, 5], label: t("expected") };
const SERIES = {
  one: [EXPECTED, { colour: "--blue", width: 2, fill: "54", label: t("measured"), isRange: true, order: -1 }],
  figure: [{ colour: "--grey", dots: true, label: t("measured") }, EXPECTED],
};

function draw(name, unit, tables) {
  const least = name === "one" ? () => 0 : (low, high) => roomy(low, high)[0];
  if (!plots[name]) {
    const span = () => moments(plots[name] ? plots[name].tables[0].time : []);
    plots[name] = new Chart($(`${name}-plot`), SERIES[name], {
      home: span, all: span, least: 10, tools: $(`${name}-tools`), ticks: dates,
      values: (low = 0, high = low + 100) => [least(low, high), roomy(low, high)[1]],
    });
  }
  plots[name].options.unit = unit;
  plots[name].set(tables);
}

function moments(times) { // at least a minute, also around one point alone
  const [first, last] = times.length ? [times[0], times[times.length - 1]] : [now() - 60, now()];
  const room = Math.max(0, 60 - (last - first)) / 2;
  return [first - room, last + room];
}

// --- looking -------------------------------------------------------------------------------------

function wanted() {
  const [type, id] = location.hash.slice(1).split("/");
  return type && id !== undefined ? { type: decodeURIComponent(type), id: decodeURIComponent(id) } : null;
}

async function look() {
  const asked = wanted();
  try {
    const now = await get("/api/all");
    const detail = asked && await get(`/api/all/one?${new URLSearchParams(asked)}`);
    if (location.hash.length > 1 !== Boolean(asked)) return;
    skew = now.now - Date.now() / 1000;
    zone = now.zone;
    told = now;
    one = detail;
    heardMs = performance.now();
  } catch (error) {
    if (asked) showBanner(error.message);
  }
  show();
}

function show() {
  if (!told) return;
  const silent = performance.now() - heardMs > SILENT_MS;
  if (silent) {
    const lost = (ejector) => ({ ...ejector, light: "grey", words: t("No connection") });
    told = { ...told, ejectors: told.ejectors.map(lost), counts: { grey: told.ejectors.length } };
    one = one && lost(one);
  }
  const said = silent ? t("No connection to the page: nothing here is up to date") : t("connected");
  $("connection").classList.toggle("bad", silent);
  if ($("connection").textContent !== said) $("connection").textContent = said;
  if (!wanted() || one) {
    const since = told.trouble_since ? t("since {time}", { time: told.trouble_since }) : "";
    showBanner(told.trouble ? `${told.trouble} ${since}. ${t("What follows is as it was then.")}` : "");
  }
  $("list").hidden = Boolean(wanted());
  $("one").hidden = !wanted() || !one;
  if (!wanted()) showList();
  else if (one) showOne();
}

function showBanner(said) {
  $("banner").hidden = !said;
  if ($("banner").textContent !== said) $("banner").textContent = said;
}

async function lookOn() {
  await look();
  setTimeout(lookOn, LOOK_MS);
}

async function begin() {
  me = await get("/api/me");
  offerLanguages(me.languages);
  $("who").textContent = me.user;
  $("login").hidden = Boolean(me.user);
  $("logout").hidden = !me.user;
  $("own").hidden = !me.ejectors.length;
}

async function logout() {
  await fetch("/api/logout", { method: "POST", headers: { "x-csrf-token": me.csrf } });
  location.reload();
}

$("search").addEventListener("input", () => { if (told) showList(); });
$("figure").addEventListener("change", () => {
  plots.figure.goHome();
  showPlots();
});
$("logout").addEventListener("click", logout);
addEventListener("hashchange", () => {
  for (const plot of Object.values(plots)) if (plot) plot.goHome();
  one = null;
  scrollTo(0, 0);
  look();
});
begin().then(lookOn, (error) => { $("connection").textContent = error.message; });
