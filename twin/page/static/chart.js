// Curves over time, drawn by uPlot: here is which stretch is shown, and what stands beside the curves.
"use strict";

const FONT = "15px system-ui, sans-serif";
const BOTTOM_PX = 26; // room for what stands at the ticks of time
const SIDE_PX = 28; // half of the widest of them
const READING_PX = 36; // two lines of the values at the pointer
const LABEL_PX = { rows: 3, top: 3, high: 18, beside: 4, around: 2 }; // of marks, in rows from the top
const TICK_PX = { time: 90, value: 44 }; // between two ticks, at least
const ZOOM = 2; // by one press
const DATES = LANGUAGE === "en" ? "en-GB" : LANGUAGE; // the day before the month, and 24 hours
const DAY_S = 86400;
const MONDAY_S = 4 * DAY_S; // the first one after 1970 began
const STEPS = Array.from({ length: 45 }, (_, i) => Number(`${[1, 2, 5][i % 3]}e${Math.floor(i / 3) - 6}`));
const DATE_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200,
  ...[1, 2, 3, 7, 14, 28, 56, 112, 224].map((days) => days * DAY_S)];

// --- ticks and values ----------------------------------------------------------------------------

// Of an axis of time: steps that ticks may have (s), a moment from which they count, and texts.

const secondsBefore = (end) => ({
  steps: STEPS,
  origin: end,
  text: (time, step) => `${number(time - end(), digitsOf(step))} s`,
  exactly: (time) => `${number(time - end(), 2)} s`,
});

const dates = { // full hours, days and Mondays of the server's zone
  steps: DATE_STEPS_S,
  origin: () => MONDAY_S - (zone === null ? -60 * new Date().getTimezoneOffset() : zone),
  text: dateText,
  exactly: (time, width) => there(time).toLocaleString(DATES, {
    day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit",
    ...(width < 60 ? { fractionalSecondDigits: 3 } : {}),
  }),
};

function dateText(tick, step) {
  const then = there(tick);
  const midnight = step >= 1 && then.getHours() === 0 && then.getMinutes() === 0 && then.getSeconds() === 0;
  const fraction = step < 1 ? { fractionalSecondDigits: 1 } : {};
  const seconds = step < 60 ? { second: "2-digit", ...fraction } : {};
  return midnight ? then.toLocaleDateString(DATES, { day: "numeric", month: "short" })
    : then.toLocaleTimeString(DATES, { hour: "2-digit", minute: "2-digit", ...seconds });
}

function ticksFrom(origin, step, from, to) {
  const first = Math.ceil((from - origin) / step - 1e-9);
  const count = Math.max(0, Math.floor((to - origin) / step + 1e-9) - first + 1);
  return Array.from({ length: count }, (_, i) => origin + (first + i) * step);
}

const digitsOf = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

function roomy(low, high) { // a range of values with some room around
  const room = Math.max((high - low) * 0.08, Math.abs(high) * 0.02, 1e-6);
  return [low - room, high + room];
}

/* The boxes of labels of marks at x, in px: each beside its mark, in the first row where it overlaps
   none before it. What is left out has no room in any row. */
function placed(labels, width, measure) {
  const { rows, top, high, beside, around } = LABEL_PX;
  const taken = Array.from({ length: rows }, () => []);
  return labels.flatMap((label) => {
    const wide = measure(label.text) + 2 * around;
    const isAtEdge = label.x + beside + wide > width;
    const left = isAtEdge ? Math.max(label.x - beside - wide, 0) : label.x + beside;
    const box = { left, right: left + wide };
    const isFree = (one) => box.right <= one.left || one.right <= box.left;
    const row = box.right > width ? -1 : taken.findIndex((others) => others.every(isFree));
    if (row < 0) return [];
    taken[row].push(box);
    return [{ ...label, ...box, top: top + row * high }];
  });
}

// --- the chart -----------------------------------------------------------------------------------

const AXIS = {
  font: FONT, stroke: () => colour("--ink"),
  grid: { stroke: () => colour("--line"), width: 1 }, ticks: { stroke: () => colour("--line"), width: 1, size: 5 },
};

function withColumns(series) { // of uPlot's data, whose first one is the time
  let next = 1;
  return series.map((one) => {
    const first = next;
    next += one.isRange ? 2 : 1;
    return { ...one, first, last: next - 1 };
  });
}

function optionsOf({ colour: name, width = 0, dash = [], dots = false, spanGaps = false }) {
  return {
    pxAlign: 0, // smooth, where a curve is neither level nor upright
    stroke: () => colour(name), width, dash: dash.map((px) => px * uPlot.pxRatio), spanGaps,
    points: { show: dots, size: 5, width: 0, fill: () => colour(name) },
  };
}

/* Series: [{colour, width, dash, fill, dots, spanGaps, label, order, isRange}], of which uPlot draws two
   where it is a range from low to high. Fill: the opacity between these as two hexadecimal digits.
   What has a label is told at the pointer, in order.
   Options. home: () => [from, to] in s, what is shown at first and which end moves on; all: () =>
   [from, to], as far as it can be seen; least and most: s, the shortest and the longest stretch; values: (low, high) =>
   [low, high] of the axis, which are undefined where there is nothing; ticks: those of time; unit;
   tools: where buttons go; back: the text of one; bands: (from, to) => [{from, to, colour, text}];
   marks: () => [{at, text, colour, dash, from, to}], from and to of when it may have been, those whose
   labels matter most first; moved: called when another stretch is shown; leave: called in place of going home. */
class Chart {
  constructor(box, series, options) {
    this.use(options);
    this.box = box;
    this.series = withColumns(series);
    this.tables = series.map(() => ({ time: [], low: [], high: [] }));
    this.width = this.end = null; // s: what a person has chosen to see
    this.fingers = new Map();
    this.reading = element("p", { class: "reading", "aria-hidden": "true" });
    box.replaceChildren(this.reading);
    box.tabIndex = 0;
    this.plot = new uPlot(this.layout(), this.columns(), box);
    const press = (text, label, onclick) => element("button", { type: "button", "aria-label": label, onclick }, text);
    this.home = press(this.options.back, this.options.back, () => this.goHome());
    this.options.tools.replaceChildren(this.home,
      press("−", t("Zoom out"), () => this.zoom(ZOOM)), press("+", t("Zoom in"), () => this.zoom(1 / ZOOM)));
    this.listen();
    this.moved();
  }

  use(options) { // from now on; buttons stay as they were made
    const common = { bands: () => [], marks: () => [], moved: () => {}, unit: "", back: t("All"), most: Infinity };
    this.options = { ...common, ...options };
  }

  listen() {
    const { box, plot: { over } } = this;
    new ResizeObserver(() => this.update()).observe(box);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.update());
    over.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return; // the page scrolls; two fingers on a touchpad come with ctrl
      event.preventDefault();
      this.zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY) / 100, 0.5)), this.timeAt(event.offsetX));
    }, { passive: false });
    over.addEventListener("pointerdown", (event) => {
      over.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, event.offsetX);
    });
    over.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      over.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    }
    over.addEventListener("dblclick", () => this.goHome());
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

  set(tables) { // {time, low, high} of each series; high where it is a range
    this.tables = tables;
    this.update();
  }

  update() { // once for what comes before the next picture
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.waits = false;
    const { plot, box: { clientWidth: width, clientHeight: height } } = this;
    if (!width || !height) return; // hidden; drawn when it is seen
    if (width !== plot.width || height !== plot.height) plot.setSize({ width, height });
    plot.setData(this.columns());
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

  timeAt(px) { // also where another stretch is not drawn yet
    const [from, to] = this.range();
    return from + (px / this.plot.over.clientWidth) * (to - from);
  }

  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (before === undefined) return;
    const others = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, px]) => px);
    this.fingers.set(event.pointerId, event.offsetX);
    const moved = this.timeAt(before) - this.timeAt(event.offsetX);
    if (!others.length) this.pan(moved);
    else if (Math.abs(event.offsetX - others[0]) > 20) {
      this.zoom(Math.abs((before - others[0]) / (event.offsetX - others[0])), this.timeAt(others[0]));
    }
  }

  // --- what uPlot is told ---

  columns() { // one time for all
    return uPlot.join(this.tables.map(({ time, low, high }, i) => (this.series[i].isRange ? [time, low, high] : [time, low])));
  }

  layout() {
    const { box, series, options: { values } } = this;
    const told = series.filter(({ label }) => label).flatMap(({ first, last }) => [first, last]);
    return {
      width: box.clientWidth, height: box.clientHeight,
      padding: [() => (this.options.unit ? READING_PX : 10), SIDE_PX, 0, 0],
      legend: { show: false },
      cursor: { y: false, drag: { x: false }, points: { size: (_, column) => (told.includes(column) ? 7 : 0) } },
      select: { show: false },
      scales: {
        x: { time: false, range: () => this.range() },
        y: { range: (_, low, high) => values(low ?? undefined, high ?? undefined) },
      },
      axes: [this.timeAxis(), this.valueAxis()],
      series: [{}, ...series.flatMap((one) => (one.isRange ? [optionsOf(one), optionsOf(one)] : [optionsOf(one)]))],
      bands: series.filter(({ fill }) => fill).map(
        ({ first, last, colour: name, fill }) => ({ series: [last, first], fill: () => colour(name) + fill })),
      hooks: {
        drawClear: [() => this.inside(() => this.drawBands())],
        draw: [() => this.inside(() => this.drawMarks()), () => this.drawUnit()],
        setCursor: [() => this.read()],
      },
    };
  }

  timeAxis() {
    const ticks = () => this.options.ticks;
    return {
      ...AXIS, size: BOTTOM_PX, gap: 3, space: TICK_PX.time,
      incrs: () => ticks().steps,
      splits: (_, axis, from, to, step) => ticksFrom(ticks().origin(), step, from, to),
      values: (_, times, axis, space, step) => times.map((time) => ticks().text(time, step)),
    };
  }

  valueAxis() {
    return {
      ...AXIS, gap: 3, space: TICK_PX.value, incrs: STEPS,
      values: (_, values, axis, space, step) => values.map((value) => number(value, digitsOf(step))),
      size: ({ ctx, axes }, texts) => {
        [ctx.font] = axes[1].font;
        const widest = Math.max(0, ...(texts || []).map((text) => ctx.measureText(text).width));
        return Math.max(SIDE_PX, 14 + widest / uPlot.pxRatio);
      },
    };
  }

  read() { // the values at the pointer
    const { data, cursor: { idx, idxs }, scales: { y } } = this.plot;
    if (idx === null) {
      this.reading.replaceChildren();
      return;
    }
    const [from, to] = this.range();
    const digits = digitsOf((y.max - y.min) / 100);
    const told = this.series.filter(({ label, first }) => label && idxs[first] !== null)
      .sort((one, other) => (one.order ?? 0) - (other.order ?? 0));
    const values = told.map(({ label, colour: name, dots, first, last }) => {
      const texts = [first, last].map((column) => number(data[column][idxs[column]] ?? null, digits));
      const value = element("b", {}, [...new Set(texts)].join("–"));
      if (!dots) value.style.color = `var(${name})`;
      return element("span", {}, `${label} `, value);
    });
    const time = element("span", {}, this.options.ticks.exactly(data[0][idx], to - from));
    this.reading.replaceChildren(element("span", {}, time), element("span", {}, ...values));
  }

  // --- drawing beside uPlot, in pixels of the page ---

  inside(drawing) { // from the corner of where the curves are, and not beyond
    const { ctx, bbox: { left, top, width, height } } = this.plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, width, height);
    ctx.clip();
    ctx.setTransform(uPlot.pxRatio, 0, 0, uPlot.pxRatio, left, top);
    ctx.font = FONT;
    ctx.textAlign = "left";
    drawing();
    ctx.restore();
  }

  get area() { return { width: this.plot.over.clientWidth, height: this.plot.over.clientHeight }; }

  x(time) { return this.plot.valToPos(time, "x"); }

  drawUnit() {
    const { ctx } = this.plot;
    ctx.save();
    ctx.setTransform(uPlot.pxRatio, 0, 0, uPlot.pxRatio, 0, 0);
    Object.assign(ctx, { font: FONT, textAlign: "left", textBaseline: "top", fillStyle: colour("--ink") });
    ctx.fillText(this.options.unit, 4, 4);
    ctx.restore();
  }

  drawBands() {
    const { plot: { ctx }, area } = this;
    ctx.textBaseline = "bottom";
    for (const band of this.options.bands(...this.range())) {
      const [left, right] = [band.from, band.to].map((time) => Math.round(this.x(time)));
      ctx.fillStyle = colour(band.colour);
      ctx.fillRect(left, 0, right - left, area.height);
      const [from, to] = [Math.max(left, 0), Math.min(right, area.width)];
      if (!band.text || ctx.measureText(band.text).width + 8 > to - from) continue;
      ctx.fillStyle = colour("--ink");
      ctx.fillText(band.text, from + 4, area.height - 3);
    }
  }

  drawMarks() { // lines first: none is drawn over a label
    const { plot: { ctx }, area } = this;
    const marks = this.options.marks().map((mark) => ({ ...mark, x: this.x(mark.at) }));
    marks.forEach((mark) => this.line(mark));
    const seen = marks.filter(({ x }) => x >= 0 && x <= area.width);
    placed(seen, area.width, (text) => ctx.measureText(text).width).forEach((label) => this.label(label));
  }

  line({ x, colour: name, dash = [], from, to }) {
    const { plot: { ctx }, area } = this;
    ctx.strokeStyle = ctx.fillStyle = colour(name);
    if (from !== undefined) this.shade(this.x(from), this.x(to));
    ctx.lineWidth = 2;
    ctx.setLineDash(dash);
    ctx.beginPath();
    ctx.moveTo(x, 0);
    ctx.lineTo(x, area.height);
    ctx.stroke();
  }

  label({ text, colour: name, left, right, top }) { // to be read over whatever is there
    const { ctx } = this.plot;
    ctx.textBaseline = "top";
    ctx.globalAlpha = 0.8;
    ctx.fillStyle = colour("--card");
    ctx.fillRect(left, top, right - left, LABEL_PX.high - 1);
    ctx.globalAlpha = 1;
    ctx.fillStyle = colour(name);
    ctx.fillText(text, left + LABEL_PX.around, top + 1);
  }

  shade(left, right) {
    const { ctx } = this.plot;
    ctx.globalAlpha = 0.2;
    ctx.fillRect(left, 0, Math.max(right - left, 2), this.area.height);
    ctx.globalAlpha = 1;
  }
}
