"use strict";
// Puts figures that answer to pointer and keyboard in the place of the page's pictures.
(() => {
  const { html, svg, fixed, digitsOf, number, short, ticks, extent, stretches, joined, path } = draw;
  const { labels, plots } = JSON.parse(document.getElementById("data").textContent);
  const looks = new Map(labels.map((look, i) => [look.label, { ...look, colour: `var(--line${i})` }]));
  const hidden = new Set();
  const redraws = []; // one function for each panel
  let seedsShown = false;
  const EDGE = { top: 20, right: 12, bottom: 34, left: 48 };
  const MARKERS = {
    o: "M-3.5,0a3.5,3.5 0 1,0 7,0a3.5,3.5 0 1,0 -7,0Z",
    s: "M-3.2,-3.2H3.2V3.2H-3.2Z",
    D: "M0,-4.6L4.6,0L0,4.6L-4.6,0Z",
    "^": "M0,-4.4L4.2,3.2H-4.2Z",
    v: "M0,4.4L4.2,-3.2H-4.2Z",
    P: "M-1.4,-4.2H1.4V-1.4H4.2V1.4H1.4V4.2H-1.4V1.4H-4.2V-1.4H-1.4Z",
    X: "M-4,-2L-2,-4L0,-2L2,-4L4,-2L2,0L4,2L2,4L0,2L-2,4L-4,2L-2,0Z",
  };

  function yDomain(plot, lines) {
    if (plot.limits && plot.limits[0] === 0) return [-0.02, 1.02];
    const shown = lines.flatMap((line) =>
      [line.y, line.low, line.high, ...(seedsShown ? line.seeds.map((seed) => seed[2]) : [])].flat());
    let [low, high] = extent(shown);
    if (plot.limits) [low, high] = [Math.max(low, plot.limits[0]), Math.min(high, plot.limits[1])];
    if (low >= high) [low, high] = plot.limits;
    return [low - 0.04 * (high - low), high + 0.04 * (high - low)];
  }

  const band = (line, X, Y) =>
    stretches(line.x, line.low, line.high).map((points) =>
      joined([...points.map(([x, low]) => [X(x), Y(low)]),
              ...points.reverse().map(([x, , high]) => [X(x), Y(high)])]) + "Z").join("");

  function swatch(parent, look) {
    const box = svg(parent, "svg", { class: "swatch", width: 30, height: 10, "aria-hidden": "true" });
    box.style.color = look.colour;
    svg(box, "line", { class: "line", x1: 0, x2: 30, y1: 5, y2: 5, "stroke-dasharray": look.dash });
    svg(box, "path", { class: "mark", d: MARKERS[look.marker], transform: "translate(15,5)" });
  }

  function drawAxes(root, plot, [width, height], [xLow, xHigh], yRange, X, Y) {
    const y = ticks(yRange[0], yRange[1], 5);
    for (const value of y.values) {
      svg(root, "line", { class: "grid", x1: EDGE.left, x2: width - EDGE.right, y1: Y(value), y2: Y(value) });
      svg(root, "text", { x: EDGE.left - 6, y: Y(value) + 4, "text-anchor": "end" }, fixed(value, y.digits));
    }
    const bottom = height - EDGE.bottom;
    const x = ticks(xLow, xHigh, width < 400 ? 4 : 6);
    const shown = plot.x_label === "env steps" ? short : (value) => fixed(value, x.digits);
    for (const value of x.values) {
      svg(root, "line", { class: "axis", x1: X(value), x2: X(value), y1: bottom, y2: bottom + 4 });
      svg(root, "text", { x: X(value), y: bottom + 16, "text-anchor": "middle" }, shown(value));
    }
    svg(root, "line", { class: "axis", x1: EDGE.left, x2: width - EDGE.right, y1: bottom, y2: bottom });
    svg(root, "text", { x: 0, y: 10 }, `\u2191 ${plot.y_label}`);
    svg(root, "text", { x: width - EDGE.right, y: height - 4, "text-anchor": "end" }, `${plot.x_label} \u2192`);
  }

  function drawLine(root, line, place, X, Y) {
    const look = looks.get(line.label);
    const group = svg(root, "g", { "data-label": line.label });
    group.style.color = look.colour;
    svg(group, "path", { class: "band", d: band(line, X, Y) });
    if (seedsShown)
      for (const [, xs, ys] of line.seeds) svg(group, "path", { class: "seed", d: path(xs, ys, X, Y) });
    svg(group, "path", { class: "line", d: path(line.x, line.y, X, Y), "stroke-dasharray": look.dash });
    const step = Math.max(1, Math.floor(line.x.length / 7));
    for (let i = (place * 2) % step; i < line.x.length; i += step)
      if (line.y[i] != null)
        svg(group, "path", { class: "mark", d: MARKERS[look.marker], transform: `translate(${X(line.x[i])},${Y(line.y[i])})` });
  }

  /** The line's point nearest to x; null where x is beyond its ends. */
  function nearest(line, x) {
    const last = line.x.length - 1;
    const reach = (line.x[last] - line.x[0]) / (last || 1);
    let best = 0;
    for (let i = 1; i <= last; i++) if (Math.abs(line.x[i] - x) < Math.abs(line.x[best] - x)) best = i;
    return Math.abs(line.x[best] - x) <= reach ? best : null;
  }

  function makePanel(parent, plot, panel) {
    const box = html(parent, "div", { class: "panel" });
    html(box, "h4", {}, panel.task);
    const area = html(box, "div", { class: "plot" });
    const root = svg(area, "svg", { role: "img", "aria-label": panel.text });
    const readout = html(box, "table", { class: "readout" });
    const xs = [...new Set(panel.lines.flatMap((line) => line.x))].filter((x) => x != null).sort((a, b) => a - b);
    if (!xs.length) {
      html(readout, "caption", {}, "No data.");
      root.remove();
      return;
    }
    const steps = plot.x_label === "env steps";
    const drawn = new Set(plot.panels.flatMap((one) => one.lines.map((line) => line.label)));
    const rest = Math.floor((xs.length - 1) * (steps ? 1 : 0.5));
    const input = html(area, "input", {
      type: "range", min: 0, max: xs.length - 1, value: rest,
      "aria-label": `${plot.title} of ${panel.task}: ${plot.x_label}`,
    });
    input.value = rest;
    const xDomain = extent(steps ? [0, ...xs] : xs);
    let width = 0, height = 0, digits = 0, X = null, Y = null, overlay = null;

    function draw() {
      width = area.clientWidth || 480;
      height = Math.round(Math.min(340, Math.max(230, width / 2)));
      const lines = panel.lines.filter((line) => !hidden.has(line.label));
      const yRange = yDomain(plot, lines);
      const [right, bottom] = [width - EDGE.right, height - EDGE.bottom];
      X = (x) => EDGE.left + ((x - xDomain[0]) / (xDomain[1] - xDomain[0])) * (right - EDGE.left);
      Y = (y) => bottom - ((y - yRange[0]) / (yRange[1] - yRange[0])) * (bottom - EDGE.top);
      digits = digitsOf(yRange);
      root.replaceChildren();
      root.setAttribute("viewBox", `0 0 ${width} ${height}`);
      drawAxes(root, plot, [width, height], xDomain, yRange, X, Y);
      const id = `clip-${plot.name}-${redraws.indexOf(draw)}`;
      const clip = svg(root, "clipPath", { id });
      svg(clip, "rect", { x: EDGE.left, y: EDGE.top - 4, width: right - EDGE.left + 4, height: bottom - EDGE.top + 8 });
      const inside = svg(root, "g", { "clip-path": `url(#${id})` });
      lines.forEach((line, place) => drawLine(inside, line, place, X, Y));
      overlay = svg(inside, "g", { class: "overlay" });
      showValues();
    }

    function showValues() {
      const x = xs[input.value];
      const at = steps ? `${short(x)} env steps` : `a ${plot.x_label} of ${number(x, digitsOf(xDomain))}`;
      overlay.replaceChildren();
      svg(overlay, "line", { class: "cursor", x1: X(x), x2: X(x), y1: EDGE.top, y2: height - EDGE.bottom });
      readout.replaceChildren();
      html(readout, "caption", {}, `At ${at}`);
      const body = html(readout, "tbody");
      const said = [];
      for (const [label, look] of looks) {
        if (hidden.has(label) || !drawn.has(label)) continue;
        const line = panel.lines.find((one) => one.label === label);
        const i = line ? nearest(line, x) : null;
        const [y, low, high] = i === null ? [null, null, null] : [line.y[i], line.low[i], line.high[i]];
        const row = html(body, "tr");
        const head = html(row, "th", { scope: "row" });
        swatch(head, look);
        html(head, "span", {}, label);
        html(row, "td", {}, number(y, digits));
        html(row, "td", {}, low == null ? "" : `[${number(low, digits)}, ${number(high, digits)}]`);
        said.push(`${label} ${number(y, digits)}`);
        if (y == null) continue;
        const dot = svg(overlay, "circle", { class: "mark", cx: X(line.x[i]), cy: Y(y), r: 4 });
        dot.style.color = look.colour;
      }
      input.setAttribute("aria-valuetext", `${at}: ${said.join("; ")}`);
    }

    function follow(event) {
      const bounds = root.getBoundingClientRect();
      const x = ((event.clientX - bounds.left) / bounds.width) * width;
      let best = 0;
      for (let i = 1; i < xs.length; i++) if (Math.abs(X(xs[i]) - x) < Math.abs(X(xs[best]) - x)) best = i;
      input.value = best;
      showValues();
    }

    input.addEventListener("input", showValues);
    area.addEventListener("pointermove", follow);
    area.addEventListener("pointerdown", (event) => {
      follow(event);
      input.focus({ preventScroll: true });
      event.preventDefault();
    });
    area.addEventListener("pointerleave", (event) => {
      if (event.pointerType !== "mouse" || document.activeElement === input) return;
      input.value = rest;
      showValues();
    });
    redraws.push(draw);
    draw();
    new ResizeObserver(() => { if (area.clientWidth !== width) draw(); }).observe(area);
  }

  function toggle(parent, text, kind, pressed, change) {
    const button = html(parent, "button", { type: "button", class: kind, "aria-pressed": pressed });
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", on);
      change(on);
      redraws.forEach((draw) => draw());
    });
    html(button, "span", {}, text);
    return button;
  }

  const lines = plots.flatMap((plot) => plot.panels.flatMap((panel) => panel.lines));
  const seedsExist = lines.some((line) => line.seeds.length > 1);
  function makeLegend(before) {
    const legend = html(null, "div", { class: "legend", role: "group", "aria-label": "What the figures show" });
    for (const [label, look] of looks) {
      const button = toggle(legend, label, "arm", true, (on) => on ? hidden.delete(label) : hidden.add(label));
      swatch(button, look);
      button.prepend(button.lastChild);
    }
    if (seedsExist)
      toggle(legend, "each seed", "seeds", false, (on) => { seedsShown = on; });
    before.before(legend);
  }

  if (plots.length && (labels.length > 1 || seedsExist)) makeLegend(document.getElementById("plots"));
  for (const plot of plots) {
    const figure = document.getElementById(plot.name);
    const panels = html(figure, "div", { class: "panels" });
    for (const panel of plot.panels) makePanel(panels, plot, panel);
    figure.querySelector("img").remove(); // only now: what cannot be drawn stays a picture
  }
})();
