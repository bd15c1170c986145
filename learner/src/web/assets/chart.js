// A line chart in SVG: axes, grid, lines, and the values under the pointer.

import { draw, make, short, steps } from "./text.js";

/** Pixels from one tick to the next, about. */
const TICK_GAP = { x: 90, y: 44 };
const TICK_GAP_COMPACT = { x: 48, y: 30 };

/** Round numbers in [low, high], about `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
  const all = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i += 1) all.push(i * step);
  return all;
}

/** As short as it can be told: ticks are round numbers. */
function tickText(value) {
  const size = Math.abs(value);
  if (size > 0 && size < 1e-3) return short(value);
  const sign = value < 0 ? "−" : "";
  return sign + (size >= 1e4 ? steps(size) : String(Number(size.toPrecision(6))));
}

/** Points whose x differ by less than a pixel become one, their mean. */
function thin(points, pixel) {
  if (pixel <= 0) return points;
  const thinned = [];
  let bucket = null;
  for (const [x, y] of points) {
    const at = Math.floor(x / pixel);
    if (bucket?.at === at) {
      bucket.n += 1;
      bucket.x += x;
      bucket.y += y;
    } else {
      thinned.push((bucket = { at, n: 1, x, y }));
    }
  }
  return thinned.map(({ n, x, y }) => [x / n, y / n]);
}

/** The point nearest to x. */
function nearest(points, x) {
  let low = 0;
  let high = points.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (points[middle][0] < x) low = middle + 1;
    else high = middle;
  }
  const before = points[low - 1];
  return before && x - before[0] < points[low][0] - x ? before : points[low];
}

export class Chart {
  /**
   * In `element`. `range` is what the y axis shows at least, if anything; `compact` leaves out what a small chart
   * has no room for.
   */
  constructor(element, { label, range = null, compact = false }) {
    this.element = element;
    this.range = range;
    this.compact = compact;
    this.margin = compact
      ? { left: 40, right: 10, top: 6, bottom: 20 }
      : { left: 52, right: 16, top: 10, bottom: 40 };
    this.series = [];
    this.emptyText = "";
    this.svg = draw("svg", { role: "img", "aria-label": label });
    this.tip = make("div", { class: "tip", hidden: "" });
    element.append(this.svg, this.tip);
    new ResizeObserver(() => this.#render()).observe(element);
    this.svg.addEventListener("pointermove", (event) => this.#point(event));
    this.svg.addEventListener("pointerleave", () => this.#unpoint());
  }

  /** Shows series `{ name, colour, points: [[x, y], …] }`, x ascending; or a text where there is none. */
  show(series, emptyText = "") {
    this.series = series.filter(({ points }) => points.length > 0);
    this.emptyText = emptyText;
    this.#render();
  }

  #render() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width < 60 || height < 40) return;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.replaceChildren();
    this.tip.hidden = true;
    if (this.series.length === 0) {
      const middle = { x: width / 2, y: height / 2, class: "empty", "text-anchor": "middle" };
      this.svg.append(draw("text", middle, this.emptyText));
      return;
    }
    this.#scale(width, height);
    this.#axes(width, height);
    for (const { colour, points } of this.series) {
      const shown = thin(points, this.xPerPixel);
      const path = shown.map(([x, y]) => `${this.x(x).toFixed(1)} ${this.y(y).toFixed(1)}`).join("L");
      this.svg.append(draw("path", { class: `series c${colour}`, d: `M${path}` }));
      const [x, y] = shown.at(-1);
      this.svg.append(draw("circle", { class: `end c${colour}`, cx: this.x(x), cy: this.y(y), r: this.compact ? 2.5 : 3.5 }));
    }
    this.pointer = draw("g", { class: "pointer" });
    this.svg.append(this.pointer);
  }

  #scale(width, height) {
    const { left, right, top, bottom } = this.margin;
    const xs = this.series.flatMap(({ points }) => [points[0][0], points.at(-1)[0]]);
    const ys = this.series.flatMap(({ points }) => points.map(([, y]) => y));
    let [low, high] = [...ys, ...(this.range ?? [])].reduce(
      ([least, most], y) => [Math.min(least, y), Math.max(most, y)],
      [Infinity, -Infinity],
    );
    const room = (high - low || Math.abs(high) || 1) * 0.06;
    const [lowest, highest] = this.range ?? [-Infinity, Infinity];
    if (low !== lowest) low -= room;
    if (high !== highest) high += room;
    const last = Math.max(...xs, 1);
    this.low = low;
    this.high = high;
    this.last = last;
    this.x = (x) => left + (x / last) * (width - left - right);
    this.y = (y) => top + ((high - y) / (high - low)) * (height - top - bottom);
    this.xPerPixel = last / (width - left - right);
  }

  #axes(width, height) {
    const { left, right, top, bottom } = this.margin;
    const base = height - bottom;
    const axes = draw("g", { class: "axes" });
    const gap = this.compact ? TICK_GAP_COMPACT : TICK_GAP;
    for (const y of ticks(this.low, this.high, (base - top) / gap.y)) {
      axes.append(
        draw("line", { x1: left, x2: width - right, y1: this.y(y), y2: this.y(y) }),
        draw("text", { x: left - 8, y: this.y(y), "text-anchor": "end", dy: "0.32em" }, tickText(y)),
      );
    }
    const xTicks = ticks(0, this.last, (width - left - right) / gap.x);
    for (const x of xTicks) {
      const anchor = this.x(x) > width - right - 20 ? "end" : "middle";
      axes.append(draw("text", { x: this.x(x), y: base + 15, "text-anchor": anchor }, steps(x)));
    }
    axes.append(draw("line", { class: "base", x1: left, x2: width - right, y1: base, y2: base }));
    if (!this.compact) {
      const middle = (left + width - right) / 2;
      axes.append(draw("text", { class: "unit", x: middle, y: height - 4, "text-anchor": "middle" }, "environment steps"));
    }
    this.svg.append(axes);
  }

  #point(event) {
    if (this.series.length === 0) return;
    const box = this.svg.getBoundingClientRect();
    const at = (event.clientX - box.left - this.margin.left) * this.xPerPixel;
    const found = this.series.map((series) => ({ ...series, point: nearest(series.points, at) }));
    const x = found[0].point[0];
    const base = this.element.clientHeight - this.margin.bottom;
    this.pointer.replaceChildren(
      draw("line", { x1: this.x(x), x2: this.x(x), y1: this.margin.top, y2: base }),
      ...found.map(({ colour, point }) =>
        draw("circle", { class: `end c${colour}`, cx: this.x(point[0]), cy: this.y(point[1]), r: 3.5 }),
      ),
    );
    this.tip.replaceChildren(
      make("strong", {}, `${steps(x)} steps`),
      ...found.map(({ name, colour, point }) =>
        make("span", {}, make("i", { class: `swatch c${colour}` }), `${name} `, make("b", {}, short(point[1]))),
      ),
    );
    this.tip.hidden = false;
    const left = this.x(x) + 12;
    const over = left + this.tip.offsetWidth > this.element.clientWidth;
    this.tip.style.left = `${over ? this.x(x) - 12 - this.tip.offsetWidth : left}px`;
  }

  #unpoint() {
    this.pointer?.replaceChildren();
    this.tip.hidden = true;
  }
}
