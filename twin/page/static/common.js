// What the pages share. What comes from the server is put in as text, never as markup.
"use strict";

const SILENT_MS = 5000; // since the page's own server said something

const $ = (id) => document.getElementById(id);
let skew = 0; // seconds that the server's clock is ahead of the one here
let zone = null; // seconds that the server's zone is ahead of UTC: all times are told in it

// --- languages -----------------------------------------------------------------------------------

const fill = (text, values) => text.replace(/\{(\w+)\}/g, (_, name) => values[name]);
const t = (text, values = {}) => fill(TEXTS[text] ?? text, values);

function tn(singular, plural, count, values = {}) { // the form of a text for a count
  const forms = TEXTS[singular];
  const text = forms ? forms[pluralForm(count)] : count === 1 ? singular : plural;
  return fill(text, { count: number(count, 0), ...values });
}

function offerLanguages(languages) {
  $("language").replaceChildren(...languages.map(({ code, name }) => element(
    "option", { value: code, lang: code, selected: code === LANGUAGE }, name)));
  $("language").onchange = () => location.assign(`/language/${$("language").value}`);
}

// --- small things --------------------------------------------------------------------------------

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== false && value !== null) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((one) => one !== null));
  return made;
}

function icon(name) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  const use = document.createElementNS(space, "use");
  svg.setAttribute("aria-hidden", "true");
  svg.setAttribute("viewBox", "0 0 48 48");
  use.setAttribute("href", `#icon-${name}`);
  svg.append(use);
  return svg;
}

function there(seconds) { // a date whose hours and days are those of the server's zone
  const here = new Date(Math.round(seconds * 1000));
  return zone === null ? here : new Date(here.getTime() + (zone + here.getTimezoneOffset() * 60) * 1000);
}

function number(value, digits) {
  if (value === null) return "–";
  const text = value.toFixed(digits);
  const sign = value < 0 && Number(text) !== 0 ? "−" : "";
  const [whole, fraction] = text.replace("-", "").split(".");
  const grouped = whole.length < 5 ? whole : whole.replace(/\B(?=(\d{3})+$)/g, GROUP);
  return sign + grouped + (fraction ? DECIMAL + fraction : "");
}

const now = () => Date.now() / 1000 + skew;
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

async function get(path) {
  const answer = await fetch(path, { headers: { accept: "application/json" } });
  if (answer.status === 401) location.assign("/login");
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error);
  return told;
}

function rows(pairs) {
  const filled = pairs.filter(([, text]) => text);
  return element("dl", { class: "rows" }, ...filled.flatMap(
    ([name, text]) => [element("dt", {}, name), element("dd", {}, text)]));
}
