"use strict";
// What the page of `sauna inspect` draws with.
const draw = (() => {
  const html = (parent, name, attributes = {}, text = null) =>
    add(parent, document.createElement(name), attributes, text);
  const svg = (parent, name, attributes = {}, text = null) =>
    add(parent, document.createElementNS("http://www.w3.org/2000/svg", name), attributes, text);
  function add(parent, element, attributes, text) {
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== null) element.textContent = text;
    if (parent) parent.append(element);
    return element;
  }

  const fixed = (value, digits) =>
    value.toLocaleString("en-US", { minimumFractionDigits: digits, maximumFractionDigits: digits })
      .replace("-", "\u2212");
  const number = (value, digits) => value == null ? "-" : fixed(value, digits);

  /** Round numbers within [low, high], about `count` of them, and the decimals they need. */
  function ticks(low, high, count) {
    const rough = (high - low) / count;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= 0.75 * rough);
    const first = Math.ceil(low / step - 1e-9);
    const last = Math.floor(high / step + 1e-9);
    const values = Array.from({ length: last - first + 1 }, (_, i) => (first + i) * step);
    return { values, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
  }

  /** Lowest and highest of the numbers, a little apart if they are one. */
  function extent(values) {
    let low = Infinity, high = -Infinity;
    for (const value of values) {
      if (value == null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) return [0, 1];
    const room = low === high ? Math.abs(low) * 0.1 || 1 : 0;
    return [low - room, high + room];
  }

  /** The stretches of points that have all of their numbers. */
  function stretches(...columns) {
    const found = [];
    let open = false;
    for (let i = 0; i < columns[0].length; i++) {
      const point = columns.map((column) => column[i]);
      const whole = point.every((value) => value != null);
      if (whole && !open) found.push([]);
      if (whole) found[found.length - 1].push(point);
      open = whole;
    }
    return found;
  }
  const joined = (points) => "M" + points.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join("L");
  const path = (xs, ys, X, Y) =>
    stretches(xs, ys).map((points) => joined(points.map(([x, y]) => [X(x), Y(y)]))).join("");

  return { html, svg, fixed, number, ticks, extent, stretches, joined, path };
})();
