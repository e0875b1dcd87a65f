// Curves over time on a canvas: bands, marks, ticks with units, zoom and pan.
"use strict";

const FONT = "15px system-ui, sans-serif";
const BOTTOM_PX = 26; // room for what stands at the ticks of time
const SIDE_PX = 28; // half of the widest of them
const TICK_PX = { time: 90, value: 44 }; // between two ticks, at least
const ZOOM = 2; // by one press
const DATES = LANGUAGE === "en" ? "en-GB" : LANGUAGE; // the day before the month, and 24 hours
const DAY_S = 86400;
const MONDAY_S = 4 * DAY_S; // the first one after 1970 began
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200,
  ...[1, 2, 3, 7, 14, 28, 56].map((days) => days * DAY_S)];

// --- ticks ---------------------------------------------------------------------------------------

function niceStep(least) { // 1, 2 or 5 times a power of ten
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((times) => times * power).find((step) => step >= least * (1 - 1e-9));
}

function multiples(step, low, high) {
  const count = Math.max(0, Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1);
  return Array.from({ length: count }, (_, i) => (Math.ceil(low / step - 1e-9) + i) * step);
}

function numberTicks(low, high, most, unit = "") {
  const step = niceStep((high - low) / Math.max(1, most));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return multiples(step, low, high).map((at) => ({ at, text: number(at, digits) + unit }));
}

function secondTicks(end) { // how long before it
  return (from, to, most) => numberTicks(from - end, to - end, most, " s")
    .map(({ at, text }) => ({ at: at + end, text }));
}

function dateTicks(from, to, most) { // at full hours, days and Mondays of the server's zone
  const step = STEPS_S.find((one) => (to - from) / one <= most) || STEPS_S[STEPS_S.length - 1];
  const ahead = (zone === null ? -60 * new Date().getTimezoneOffset() : zone) - MONDAY_S;
  const ticks = multiples(step, from + ahead, to + ahead).map((at) => at - ahead);
  return ticks.map((at) => ({ at, text: dateText(at, step) }));
}

function dateText(tick, step) {
  const then = there(tick);
  const midnight = step >= 1 && then.getHours() === 0 && then.getMinutes() === 0 && then.getSeconds() === 0;
  const fraction = step < 1 ? { fractionalSecondDigits: 1 } : {};
  const seconds = step < 60 ? { second: "2-digit", ...fraction } : {};
  return midnight ? then.toLocaleDateString(DATES, { day: "numeric", month: "short" })
    : then.toLocaleTimeString(DATES, { hour: "2-digit", minute: "2-digit", ...seconds });
}

function roomy(low, high) { // a range of values with some room around
  const room = Math.max((high - low) * 0.08, Math.abs(high) * 0.02, 1e-6);
  return [low - room, high + room];
}

// --- what is to be drawn -------------------------------------------------------------------------

function firstAfter(times, wanted) { // index of the first one that is later; times ascend
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] > wanted) high = middle; else low = middle + 1;
  }
  return low;
}

function part({ time }, from, to) { // indices of what is seen, and one more on each side
  return [Math.max(0, firstAfter(time, from) - 1), Math.min(time.length, firstAfter(time, to) + 1)];
}

// Points from low to high: all, or the lowest and highest of each pixel where there are more.
function decimate({ time, low, high = low }, [first, end], x, pixel) {
  const points = [];
  const all = end - first <= 2 * Math.abs(x(time[end - 1]) - x(time[first])) / pixel;
  let last = null;
  for (let i = first; i < end; i += 1) {
    const at = all ? x(time[i]) : Math.round(x(time[i]) / pixel) * pixel;
    const gap = low[i] === null || high[i] === null;
    if (gap || all || !last || last.x !== at) points.push({ x: at, low: low[i], high: high[i], gap });
    else {
      last.low = Math.min(last.low, low[i]);
      last.high = Math.max(last.high, high[i]);
    }
    last = gap ? null : points[points.length - 1];
  }
  return points;
}

function runs(points) { // between gaps
  const found = [[]];
  for (const point of points) {
    if (point.gap) found.push([]); else found[found.length - 1].push(point);
  }
  return found.filter((run) => run.length);
}

// --- the chart -----------------------------------------------------------------------------------

/* Options. home: () => [from, to] in s, what is shown at first and which end moves on; all: () =>
   [from, to], as far as it can be seen; least and most: s, the shortest and the longest stretch; values: (low, high) =>
   [low, high] of the axis, which are undefined where there is nothing; ticks: () => (from, to, most)
   => [{at, text}]; unit; tools: where buttons go; back: the text of one; bands: (from, to) => [{from,
   to, colour, text}]; marks: () => [{at, text, colour, dash, from, to}], from and to of when it may
   have been; moved: called when another stretch is shown; leave: called in place of going home.
   A series: {time, low, high, colour, width, dash, fill, dots}; high is low if it is not given. */
class Chart {
  constructor(box, options) {
    this.use(options);
    this.series = [];
    this.width = this.end = null; // s: what a person has chosen to see
    this.fingers = new Map();
    this.canvas = element("canvas");
    this.ctx = this.canvas.getContext("2d");
    box.replaceChildren(this.canvas);
    box.tabIndex = 0;
    const press = (text, label, onclick) => element("button", { type: "button", "aria-label": label, onclick }, text);
    this.home = press(this.options.back, this.options.back, () => this.goHome());
    this.options.tools.replaceChildren(this.home,
      press("−", t("Zoom out"), () => this.zoom(ZOOM)), press("+", t("Zoom in"), () => this.zoom(1 / ZOOM)));
    this.listen(box);
    this.moved();
  }

  use(options) { // from now on; buttons stay as they were made
    const common = { bands: () => [], marks: () => [], moved: () => {}, unit: "", back: t("All"), most: Infinity };
    this.options = { ...common, ...options };
  }

  listen(box) {
    const { canvas } = this;
    new ResizeObserver(() => this.draw()).observe(box);
    addEventListener("resize", () => this.update()); // also where only the size of a pixel changes
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.update());
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return; // the page scrolls; two fingers on a touchpad come with ctrl
      event.preventDefault();
      this.zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY) / 100, 0.5)), this.timeAt(event.offsetX));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, event.offsetX);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    }
    canvas.addEventListener("dblclick", () => this.goHome());
    box.addEventListener("keydown", (event) => {
      const [from, to] = this.range();
      const deeds = {
        ArrowLeft: () => this.pan((from - to) / 10), ArrowRight: () => this.pan((to - from) / 10),
        "+": () => this.zoom(1 / ZOOM), "-": () => this.zoom(ZOOM), Home: () => this.goHome(),
      };
      if (!deeds[event.key]) return;
      event.preventDefault();
      deeds[event.key]();
    });
  }

  set(series) {
    this.series = series;
    this.update();
  }

  update() { // once for what comes before the next picture
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => this.draw());
  }

  // --- which stretch is seen ---

  range() {
    const [from, to] = this.options.home();
    const end = this.end === null ? to : this.end;
    return [end - (this.width === null ? to - from : this.width), end];
  }

  get isHome() { return this.width === null && this.end === null; }

  show(from, to) { // as far as there is something, and with the end that moves on if it is reached
    const [first, last] = this.options.all();
    const [, end] = this.options.home();
    const most = Math.min(this.options.most, last - first);
    this.width = Math.max(Math.min(to - from, most), Math.min(this.options.least, most));
    const shown = Math.min(Math.max(to, first + this.width), last);
    this.end = shown >= end - this.width / 1000 ? null : shown;
    this.moved();
  }

  zoom(times, around) {
    const [from, to] = this.range();
    const kept = around === undefined ? (this.end === null ? to : (from + to) / 2) : around;
    const width = Math.max((to - from) * times, this.options.least);
    const begin = kept - ((kept - from) / (to - from)) * width;
    this.show(begin, begin + width);
  }

  pan(seconds) {
    const [from, to] = this.range();
    this.show(from + seconds, to + seconds);
  }

  goHome() {
    if (this.options.leave) {
      this.options.leave();
      return;
    }
    this.width = this.end = null;
    this.moved();
  }

  moved() {
    this.home.disabled = this.isHome && !this.options.leave;
    this.options.moved();
    this.update();
  }

  timeAt(px) {
    const [from, to] = this.range();
    return from + ((px - this.area.left) / this.area.width) * (to - from);
  }

  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (before === undefined || !this.area) return;
    const others = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, px]) => px);
    this.fingers.set(event.pointerId, event.offsetX);
    const moved = this.timeAt(before) - this.timeAt(event.offsetX);
    if (!others.length) this.pan(moved);
    else if (Math.abs(event.offsetX - others[0]) > 20) {
      this.zoom(Math.abs((before - others[0]) / (event.offsetX - others[0])), this.timeAt(others[0]));
    }
  }

  // --- drawing ---

  draw() {
    this.waits = false;
    const { canvas, ctx, options } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return; // hidden; drawn when it is seen
    const ratio = devicePixelRatio || 1;
    canvas.width = Math.round(width * ratio); // which also empties it
    canvas.height = Math.round(height * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.font = FONT;
    const [from, to] = this.range();
    const parts = this.series.map((one) => part(one, from, to));
    const [low, high] = options.values(...this.extent(parts));
    const top = options.unit ? 28 : 10;
    const values = numberTicks(low, high, (height - top - BOTTOM_PX) / TICK_PX.value);
    const left = Math.max(SIDE_PX, 14 + Math.max(0, ...values.map(({ text }) => ctx.measureText(text).width)));
    this.area = { left, top, width: width - left - SIDE_PX, height: height - top - BOTTOM_PX };
    const x = (time) => left + ((time - from) / (to - from)) * this.area.width;
    const y = (value) => top + ((high - value) / (high - low)) * this.area.height;
    this.clipped(() => this.drawBands(from, to, x));
    this.drawTicks(values, options.ticks()(from, to, this.area.width / TICK_PX.time), x, y);
    this.clipped(() => {
      this.series.forEach((one, i) => this.drawSeries(one, decimate(one, parts[i], x, 1 / ratio), y));
      this.drawMarks(x);
    });
  }

  extent(parts) { // of the values that are seen
    let [least, most] = [Infinity, -Infinity];
    this.series.forEach(({ low, high = low }, n) => {
      for (let i = parts[n][0]; i < parts[n][1]; i += 1) {
        if (low[i] !== null && low[i] < least) least = low[i];
        if (high[i] !== null && high[i] > most) most = high[i];
      }
    });
    return least <= most ? [least, most] : [undefined, undefined];
  }

  clipped(drawing) {
    const { ctx, area } = this;
    ctx.save();
    ctx.beginPath();
    ctx.rect(area.left, area.top, area.width, area.height);
    ctx.clip();
    drawing();
    ctx.restore();
  }

  drawBands(from, to, x) {
    for (const band of this.options.bands(from, to)) {
      this.ctx.fillStyle = colour(band.colour);
      const left = Math.round(x(band.from));
      const right = Math.round(x(band.to));
      this.ctx.fillRect(left, this.area.top, right - left, this.area.height);
      if (band.text) this.nameBand(band.text, left, right);
    }
  }

  nameBand(text, left, right) { // where there is room for it
    const { ctx, area } = this;
    const [from, to] = [Math.max(left, area.left), Math.min(right, area.left + area.width)];
    if (ctx.measureText(text).width + 8 > to - from) return;
    ctx.fillStyle = colour("--ink");
    ctx.textAlign = "left";
    ctx.textBaseline = "bottom";
    ctx.fillText(text, from + 4, area.top + area.height - 3);
  }

  drawTicks(values, times, x, y) {
    const { ctx, area } = this;
    ctx.strokeStyle = colour("--line");
    ctx.fillStyle = colour("--ink");
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (const { at } of values) this.line(area.left - 5, Math.round(y(at)) + 0.5, area.left + area.width);
    for (const { at } of times) this.line(Math.round(x(at)) + 0.5, area.top, null, area.top + area.height + 5);
    ctx.stroke();
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    for (const { at, text } of values) ctx.fillText(text, area.left - 8, y(at));
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    for (const { at, text } of times) { // whole, also at the edge
      const half = ctx.measureText(text).width / 2;
      const middle = Math.max(half, Math.min(x(at), area.left + area.width + SIDE_PX - half));
      ctx.fillText(text, middle, area.top + area.height + 8);
    }
    ctx.textAlign = "left";
    ctx.fillText(this.options.unit, 4, 4);
  }

  line(x, y, toX, toY) {
    this.ctx.moveTo(x, y);
    this.ctx.lineTo(toX ?? x, toY ?? y);
  }

  drawSeries(one, points, y) {
    const { ctx } = this;
    ctx.strokeStyle = ctx.fillStyle = colour(one.colour);
    ctx.lineWidth = one.width || 0;
    ctx.lineJoin = "round";
    ctx.setLineDash(one.dash || []);
    for (const run of runs(points)) {
      if (one.dots) this.drawDots(run, y);
      if (one.fill) this.fillBetween(run, y, one.fill);
      if (one.width && one.high) for (const side of ["low", "high"]) this.trace(run, (p) => [y(p[side])]);
      else if (one.width) this.trace(run, (p) => (p.low === p.high ? [y(p.low)] : [y(p.low), y(p.high)]));
    }
    ctx.setLineDash([]);
  }

  drawDots(run, y) {
    for (const { x, low, high } of run) {
      for (const value of new Set([low, high])) {
        this.ctx.beginPath();
        this.ctx.arc(x, y(value), 2.5, 0, 2 * Math.PI);
        this.ctx.fill();
      }
    }
  }

  fillBetween(run, y, opacity) {
    const { ctx } = this;
    ctx.globalAlpha = opacity;
    ctx.beginPath();
    for (const { x, high } of run) ctx.lineTo(x, y(high));
    for (const { x, low } of [...run].reverse()) ctx.lineTo(x, y(low));
    ctx.fill();
    ctx.globalAlpha = 1;
  }

  trace(run, heights) {
    this.ctx.beginPath();
    for (const point of run) for (const height of heights(point)) this.ctx.lineTo(point.x, height);
    this.ctx.stroke();
  }

  drawMarks(x) {
    const { ctx, area } = this;
    ctx.lineWidth = 2;
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    const inTime = this.options.marks().sort((one, other) => one.at - other.at);
    inTime.forEach(({ at, text, colour: name, dash = [], from, to }, i) => {
      ctx.strokeStyle = ctx.fillStyle = colour(name);
      if (from !== undefined) this.shade(x(from), x(to));
      ctx.setLineDash(dash);
      ctx.beginPath();
      this.line(x(at), area.top, null, area.top + area.height);
      ctx.stroke();
      ctx.setLineDash([]);
      if (x(at) < area.left || x(at) > area.left + area.width) return;
      const { width } = ctx.measureText(text);
      const begin = x(at) + 6 + width > area.left + area.width ? x(at) - 6 - width : x(at) + 6;
      this.label(text, begin, area.top + 4 + 18 * (i % 3), width); // beside those of the same moment
    });
  }

  label(text, left, top, width) { // to be read over whatever is there
    const { ctx } = this;
    const ink = ctx.fillStyle;
    ctx.globalAlpha = 0.8;
    ctx.fillStyle = colour("--card");
    ctx.fillRect(left - 2, top - 1, width + 4, 17);
    ctx.globalAlpha = 1;
    ctx.fillStyle = ink;
    ctx.fillText(text, left, top);
  }

  shade(left, right) {
    const { ctx, area } = this;
    ctx.globalAlpha = 0.2;
    ctx.fillRect(left, area.top, Math.max(right - left, 2), area.height);
    ctx.globalAlpha = 1;
  }
}
