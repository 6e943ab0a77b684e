"use strict";
// One time for all of the page: the picture, the lines, the numbers and the scatter show it.
(() => {
  const { html, svg, fixed, number, ticks, extent, stretches, joined, path } = draw;
  const data = JSON.parse(document.getElementById("data").textContent);
  const { series, labels, keep, words, starts, rollouts, points, frames } = data;
  const LAST = keep.length - 1;
  const WINDOW = 200; // env steps that are shown when zoomed
  const EDGE = { top: 6, right: 8, left: 48 };
  const AXIS = 32; // height of the numbers under the last track
  const STRIP = 7; // height of the strip of kept and dropped steps, on top of the first track
  const steps = keep.map((_, t) => t);
  const [slider, play, zoom] = ["time", "play", "zoom"].map((id) => document.getElementById(id));
  const picture = document.getElementById("picture");
  const listeners = []; // called with the step whenever it changes
  let now = 0, view = [0, LAST];

  const bounded = (t) => Math.min(LAST, Math.max(0, t));
  const episodeOf = (t) => starts.findLastIndex((first) => first <= t);

  function go(t) {
    now = bounded(Math.round(t));
    slider.value = now;
    const past = now < view[0] || now > view[1];
    if (past) setView();
    listeners.forEach((show) => show());
  }

  function setView() {
    const zoomed = zoom.getAttribute("aria-pressed") === "true" && LAST > WINDOW;
    const first = Math.min(Math.max(0, now - WINDOW / 2), Math.max(0, LAST - WINDOW));
    view = zoomed ? [first, first + WINDOW] : [0, LAST];
    tracks.forEach((track) => track.draw());
  }

  // The picture.

  let shown = -1;
  function showPicture() {
    const place = Math.max(0, frames.rows.findLastIndex((row) => row <= now));
    if (place === shown) return;
    shown = place;
    picture.src = "data:image/webp;base64," + frames.images[place];
    picture.dataset.row = frames.rows[place];
  }
  if (picture) listeners.push(showPicture);

  // The numbers.

  const digits = (name) => {
    const [low, high] = extent(series[name]);
    return Math.max(0, Math.min(6, 3 - Math.floor(Math.log10(Math.max(-low, high, 1e-6)))));
  };
  const cells = new Map();
  const body = html(document.getElementById("now"), "tbody");
  for (const [name, label] of [["step", "Env step"], ["episode", "Episode"], ["decision", "Decision"],
                               ...Object.entries(labels)]) {
    const row = html(body, "tr");
    html(row, "th", { scope: "row" }, label);
    cells.set(name, html(row, "td", { "data-name": name }));
  }
  const places = Object.fromEntries(Object.keys(labels).map((name) => [name, digits(name)]));
  function showNumbers() {
    const episode = episodeOf(now);
    cells.get("step").textContent = `${fixed(now, 0)} of ${fixed(LAST, 0)}`;
    cells.get("episode").textContent = `${episode + 1} of ${starts.length}, step ${fixed(now - starts[episode], 0)}`;
    const decision = cells.get("decision");
    decision.textContent = words[keep[now] ? 0 : 1];
    decision.className = keep[now] ? "" : "dropped";
    for (const name of Object.keys(labels)) {
      cells.get(name).textContent = number(series[name][now], places[name]);
      cells.get(name).dataset.value = series[name][now];
    }
    slider.setAttribute("aria-valuetext", `step ${now}, ${decision.textContent}`);
  }
  listeners.push(showNumbers);

  // The time line: one track above the other.

  /** The steps in view that are kept (or not) as one path, a box for each stretch of them. */
  function boxes(kept, X, top, bottom) {
    let found = "";
    for (let t = view[0]; t <= view[1]; t++) {
      if (Boolean(keep[t]) !== kept) continue;
      const first = t;
      while (t < view[1] && Boolean(keep[t + 1]) === kept) t++;
      const [left, right] = [X(first - 0.5).toFixed(1), X(t + 0.5).toFixed(1)];
      found += `M${left},${top}H${right}V${bottom}H${left}Z`;
    }
    return found;
  }

  /** A heading with a sample of each thing that is drawn under it: `[class, path, text]`. */
  function makeKey(box, title, samples) {
    const key = html(box, "div", { class: "key" });
    if (title) html(key, "h3", {}, title);
    for (const [kind, shape, text] of samples) {
      const one = html(key, "span");
      const sample = svg(one, "svg", { width: 18, height: 12, "aria-hidden": "true" });
      svg(sample, "path", { class: kind, d: shape });
      html(one, "span", {}, text);
    }
    return key;
  }

  function makeTrack(panel, place) {
    const box = html(document.getElementById("tracks"), "div", { class: "track", "data-name": panel.name });
    const samples = panel.lines.map((name, i) => [`line ${i ? "second" : "first"}`, "M0,6H18", labels[name]]);
    const BOX = "M2,1H16V11H2Z";
    if (panel.band) samples.push(["band", BOX, "threshold band"]);
    if (!place) samples.push(["kept-strip", BOX, words[0]], ["dropped-strip", BOX, words[1]]);
    makeKey(box, panel.title, samples.length > 1 ? samples : []);
    const root = svg(box, "svg", { role: "img", "aria-label": panel.title });
    const isLast = place === data.panels.length - 1;
    const top = EDGE.top + (place ? 0 : STRIP);
    const tall = (panel.name === "vex" ? 190 : 105) + (isLast ? AXIS : 0);
    let width = 0, X = null, Y = null, overlay = null;

    function domain() {
      const inView = (name) => series[name].slice(view[0], view[1] + 1);
      const edge = panel.band ? inView(panel.band) : [];
      const lines = panel.lines.flatMap(inView);
      // The band's mirror image below 0 matters only where a line comes near it.
      const mirrored = lines.some((y) => y < 0) ? edge.map((y) => y == null ? null : -y) : [];
      const [low, high] = extent([...lines, ...edge, ...mirrored]);
      return [low - 0.05 * (high - low), high + 0.05 * (high - low)];
    }

    function drawTrack() {
      width = box.clientWidth || 480;
      const [right, bottom] = [width - EDGE.right, tall - (isLast ? AXIS : 0) - 2];
      const [low, high] = domain();
      X = (t) => EDGE.left + ((t - view[0]) / (view[1] - view[0] || 1)) * (right - EDGE.left);
      Y = (y) => bottom - ((y - low) / (high - low)) * (bottom - top);
      root.replaceChildren();
      root.setAttribute("viewBox", `0 0 ${width} ${tall}`);
      const y = ticks(low, high, panel.name === "vex" ? 5 : 3);
      for (const value of y.values) {
        svg(root, "line", { class: "grid", x1: EDGE.left, x2: right, y1: Y(value), y2: Y(value) });
        svg(root, "text", { x: EDGE.left - 6, y: Y(value) + 4, "text-anchor": "end" }, fixed(value, y.digits));
      }
      const id = `clip-${panel.name}`;
      const clip = svg(root, "clipPath", { id });
      svg(clip, "rect", { x: EDGE.left, y: 0, width: right - EDGE.left, height: bottom });
      const inside = svg(root, "g", { "clip-path": `url(#${id})` });
      svg(inside, "path", { class: "dropped", d: boxes(false, X, place ? 0 : STRIP, bottom) });
      if (!place)
        for (const kept of [true, false])
          svg(inside, "path", { class: kept ? "kept-strip" : "dropped-strip", d: boxes(kept, X, 0, STRIP) });
      drawLines(inside);
      for (const [kind, rows] of [["rollout", rollouts], ["episode", starts]])
        for (const t of rows.filter((row) => row > 0))
          svg(inside, "line", { class: kind, x1: X(t - 0.5), x2: X(t - 0.5), y1: 0, y2: bottom });
      if (isLast) drawAxis(bottom);
      overlay = svg(inside, "g");
      showHere();
    }

    function drawLines(inside) {
      const rows = steps.slice(view[0], view[1] + 1);
      const values = (name) => series[name].slice(view[0], view[1] + 1);
      if (panel.band) {
        for (const part of stretches(rows, values(panel.band)))
          svg(inside, "path", { class: "band", d: joined([
            ...part.map(([t, y]) => [X(t), Y(y)]), ...part.reverse().map(([t, y]) => [X(t), Y(-y)])]) + "Z" });
        svg(inside, "path", { class: "edge", d: path(rows, values(panel.band), X, Y) });
        svg(inside, "path", { class: "edge", d: path(rows, values(panel.band), X, (y) => Y(-y)) });
      }
      panel.lines.forEach((name, i) => {
        const kind = i ? "second" : "first";
        svg(inside, "path", { class: `line ${kind}`, "data-series": name, d: path(rows, values(name), X, Y) });
      });
    }

    function drawAxis(bottom) {
      const x = ticks(view[0], view[1], width < 400 ? 4 : 8);
      svg(root, "line", { class: "axis", x1: EDGE.left, x2: width - EDGE.right, y1: bottom, y2: bottom });
      for (const value of x.values.filter(Number.isInteger)) {
        svg(root, "line", { class: "axis", x1: X(value), x2: X(value), y1: bottom, y2: bottom + 4 });
        svg(root, "text", { x: X(value), y: bottom + 16, "text-anchor": "middle" }, fixed(value, 0));
      }
      svg(root, "text", { x: width - EDGE.right, y: bottom + 30, "text-anchor": "end" }, "env steps \u2192");
    }

    function showHere() {
      overlay.replaceChildren();
      svg(overlay, "line", { class: "cursor", x1: X(now), x2: X(now), y1: 0, y2: tall });
      panel.lines.forEach((name, i) => {
        if (series[name][now] == null) return;
        svg(overlay, "circle", { class: `mark ${i ? "second" : "first"}`, cx: X(now), cy: Y(series[name][now]), r: 3.5 });
      });
    }

    function follow(event) {
      const bounds = root.getBoundingClientRect();
      const x = ((event.clientX - bounds.left) / bounds.width) * width;
      const share = (x - EDGE.left) / (width - EDGE.right - EDGE.left);
      go(Math.min(view[1], Math.max(view[0], view[0] + share * (view[1] - view[0]))));
    }
    root.addEventListener("pointerdown", (event) => {
      pause();
      root.setPointerCapture(event.pointerId);
      follow(event);
      slider.focus({ preventScroll: true });
      event.preventDefault();
    });
    root.addEventListener("pointermove", (event) => {
      if (root.hasPointerCapture(event.pointerId)) follow(event);
    });
    listeners.push(() => { if (overlay) showHere(); });
    new ResizeObserver(() => { if (box.clientWidth !== width) drawTrack(); }).observe(box);
    return { draw: drawTrack };
  }

  // The visited states.

  function makeScatter(box) {
    const [xs, ys] = points;
    const EDGES = 16, root = svg(box, "svg", { role: "img", "aria-label": "Visited states" });
    let width = 0, height = 0, X = null, Y = null, here = null;

    function drawStates() {
      width = box.clientWidth || 480;
      height = Math.round(width * 0.7);
      const [x, y] = [extent(xs), extent(ys)];
      X = (value) => EDGES + ((value - x[0]) / (x[1] - x[0])) * (width - 2 * EDGES);
      Y = (value) => height - EDGES - ((value - y[0]) / (y[1] - y[0])) * (height - 2 * EDGES);
      root.replaceChildren();
      root.setAttribute("viewBox", `0 0 ${width} ${height}`);
      const at = (t) => `${X(xs[t]).toFixed(1)},${Y(ys[t]).toFixed(1)}`;
      const chosen = (kept) => steps.filter((t) => Boolean(keep[t]) === kept);
      svg(root, "path", { class: "kept", d: chosen(true).map((t) => `M${at(t)}h0`).join("") });
      svg(root, "path", { class: "dropped", d: chosen(false).map((t) => `M${at(t)}m-3,-3l6,6m0,-6l-6,6`).join("") });
      svg(root, "text", { x: width - 6, y: height - 5, "text-anchor": "end" }, "first component \u2192");
      svg(root, "text", { x: 6, y: 12 }, "\u2191 second component");
      here = svg(root, "circle", { class: "here", r: 7 });
      showHere();
    }
    function showHere() {
      here.setAttribute("cx", X(xs[now]));
      here.setAttribute("cy", Y(ys[now]));
    }
    function follow(event) {
      const bounds = root.getBoundingClientRect();
      const x = ((event.clientX - bounds.left) / bounds.width) * width;
      const y = ((event.clientY - bounds.top) / bounds.height) * height;
      let best = 0, least = Infinity;
      for (const t of steps) {
        const distance = (X(xs[t]) - x) ** 2 + (Y(ys[t]) - y) ** 2;
        if (distance < least) [best, least] = [t, distance];
      }
      pause();
      go(best);
    }
    root.addEventListener("pointermove", follow);
    root.addEventListener("pointerdown", follow);
    const count = (kept) => fixed(keep.filter((k) => Boolean(k) === kept).length, 0);
    box.prepend(makeKey(null, "", [["kept", "M9,6h0", `${words[0]}: ${count(true)}`],
                                   ["dropped", "M6,3l6,6m0,-6l-6,6", `${words[1]}: ${count(false)}`]]));
    listeners.push(() => { if (here) showHere(); });
    drawStates();
    new ResizeObserver(() => { if (box.clientWidth !== width) drawStates(); }).observe(box);
  }

  // Playing, buttons and keys.

  let began = null;
  function pause() {
    began = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", false);
  }
  function frame(time) {
    if (began === null) return;
    const t = began.step + ((time - began.time) / 1000) * data.steps_per_second;
    go(t);
    if (now >= LAST) pause();
    else requestAnimationFrame(frame);
  }
  function toggle() {
    if (began !== null) return pause();
    if (now >= LAST) go(0);
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", true);
    began = { step: now, time: performance.now() };
    requestAnimationFrame(frame);
  }
  play.addEventListener("click", toggle);
  zoom.addEventListener("click", () => {
    zoom.setAttribute("aria-pressed", zoom.getAttribute("aria-pressed") !== "true");
    setView();
  });
  zoom.hidden = LAST <= WINDOW;
  slider.max = LAST;
  slider.addEventListener("input", () => {
    pause();
    go(Number(slider.value));
  });
  const KEYS = { ArrowLeft: -1, ArrowRight: 1 };
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input, button, [tabindex]") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " ") toggle();
    else if (event.key in KEYS) {
      pause();
      go(now + KEYS[event.key] * (event.shiftKey ? 10 : 1));
    } else return;
    event.preventDefault();
  });

  const tracks = data.panels.map(makeTrack);
  if (points.length) makeScatter(document.getElementById("scatter"));
  setView();
  go(0);
})();
