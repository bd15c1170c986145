// Numbers and times in words, and how elements are made.

const THIN_SPACE = "\u202f";

/** 50000 → "50 000". */
export function grouped(number) {
  return String(Math.round(number)).replace(/\B(?=(\d{3})+$)/g, THIN_SPACE);
}

/** Three significant digits, plain where that is short. */
export function short(number) {
  if (number === 0 || !Number.isFinite(number)) return String(number);
  const size = Math.abs(number);
  if (size >= 1e5 || size < 1e-3) return number.toExponential(1).replace("e+", "e").replace("-", "−");
  const digits = Math.max(0, 2 - Math.floor(Math.log10(size)));
  return number.toFixed(Math.min(digits, 4)).replace("-", "−");
}

/** Environment steps on an axis: 0, 500, 20 k, 1.5 M. */
export function steps(number) {
  const trim = (value) => String(Number(value.toFixed(2)));
  if (number >= 1e6) return `${trim(number / 1e6)} M`;
  if (number >= 1e3) return `${trim(number / 1e3)} k`;
  return String(number);
}

/** Seconds in the two largest units. */
export function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 48 * 3600) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

/** The element of this id. */
export const byId = (id) => document.getElementById(id);

/** A new element with attributes and children (texts or elements). */
export function make(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** The same of SVG. */
export function draw(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}
