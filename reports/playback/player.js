/* The player: one instant, shown in space, in all cameras' images and as a line in the plots. */
(() => {
  "use strict";
  const holder = document.getElementById("playback-data");
  const card = document.querySelector("#playback .player");
  if (!holder || !card || typeof Plotly === "undefined") return;

  const raw = JSON.parse(holder.textContent);
  const F = +raw.frames, M = raw.names.length, C = raw.cameras.length;
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const u2 = text => new Uint16Array(bytes(text)), u1 = text => new Uint8Array(bytes(text));
  const time = new Float32Array(bytes(raw.time));
  const measured = u2(raw.measured), truth = raw.true && u2(raw.true);
  const error = raw.error && new Int16Array(bytes(raw.error)), rms = raw.rms_mm && new Float32Array(bytes(raw.rms_mm));
  const state = u1(raw.state), used = raw.used && u1(raw.used), width = Math.ceil(C / 8);
  const ghostCounts = u2(raw.ghost_counts), ghosts = u2(raw.ghosts);
  const ghostStart = new Uint32Array(F + 1);
  for (let f = 0; f < F; f++) ghostStart[f + 1] = ghostStart[f] + ghostCounts[f];
  const sets = raw.sets.map(one => ({...one, images: Object.fromEntries(Object.entries(one.images).map(
    ([name, image]) => [name, {...image, xy: u2(image.xy), d: u2(image.d)}]))}));
  const NONE = 65535, NO_ERROR = -32768, MISSED = 1, FOUND = 2;

  const place = (table, i, axis) => table[3 * i + axis] === NONE ? null : raw.low[axis] + raw.step[axis] * table[3 * i + axis];
  const errorMm = (i, axis) => error[3 * i + axis] === NO_ERROR ? null : raw.error_step_mm * error[3 * i + axis];
  const distanceMm = i => error[3 * i] === NO_ERROR ? null : Math.hypot(errorMm(i, 0), errorMm(i, 1), errorMm(i, 2));
  const measuredWith = (f, m) => used ? raw.cameras.filter((_, c) => used[(f * M + m) * width + (c >> 3)] >> (c & 7) & 1) : [];
  const figure = v => v === null ? "–" : Number(v.toPrecision(3)).toString();

  const now = {frame: 0, marker: 0, playing: false};
  const layers = {};
  const $ = id => document.getElementById(id);
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const webgl = (() => {
    try { return !!document.createElement("canvas").getContext("webgl"); } catch { return false; }
  })();

  const narrow = matchMedia("(max-width:760px)").matches, far = (narrow ? 1.05 : 0.78) * (raw.cameras.length ? 1 : 1.8);

  /* colour scale of the errors: 0 to their 95 % quantile */
  const top = (() => {
    if (!error) return 1;
    const all = [];
    const stride = Math.max(1, Math.floor(F * M / 20000));
    for (let i = 0; i < F * M; i += stride) { const d = distanceMm(i); if (d !== null) all.push(d); }
    all.sort((a, b) => a - b);
    return all.length ? all[Math.min(all.length - 1, Math.floor(0.95 * all.length))] || 1 : 1;
  })();

  /* ---- space ---- */
  const BOX = 0, CAMERAS = 1, NAMES = 2, TRUE_TRAIL = 3, TRAIL = 4, TRUE = 5, MEASURED = 6, GHOSTS = 7, RAYS = 8, CHOSEN = 9;
  const layerOf = {cameras: [CAMERAS, NAMES], rays: [RAYS], measured: [MEASURED], true: [TRUE], trail: [TRUE_TRAIL, TRAIL], ghosts: [GHOSTS]};

  function lines(paths) {
    const xyz = {x: [], y: [], z: []};
    for (const path of paths) {
      for (const p of path) { xyz.x.push(p[0]); xyz.y.push(p[1]); xyz.z.push(p[2]); }
      xyz.x.push(null); xyz.y.push(null); xyz.z.push(null);
    }
    return xyz;
  }

  function boxLines() {
    const [a, b] = raw.box, corner = k => [0, 1, 2].map(axis => (k >> axis & 1 ? b : a)[axis]);
    const paths = [];
    for (let k = 0; k < 8; k++) for (const bit of [1, 2, 4]) if (!(k & bit)) paths.push([corner(k), corner(k | bit)]);
    return lines(paths);
  }

  const cameraLines = () => lines(raw.cameras.flatMap(c => [
    [...c.corners, c.corners[0]], ...c.corners.map(corner => [c.at, corner])]));

  function points(table, f) {
    const out = {x: [], y: [], z: []};
    for (let m = 0; m < M; m++) {
      out.x.push(place(table, f * M + m, 0)); out.y.push(place(table, f * M + m, 1)); out.z.push(place(table, f * M + m, 2));
    }
    return out;
  }

  function trail(table, m, from, to) {
    const out = {x: [], y: [], z: []};
    for (let f = from; f < to; f++) {
      out.x.push(place(table, f * M + m, 0)); out.y.push(place(table, f * M + m, 1)); out.z.push(place(table, f * M + m, 2));
    }
    return out;
  }

  function ghostPoints(f) {
    const out = {x: [], y: [], z: []};
    for (let i = ghostStart[f]; i < ghostStart[f + 1]; i++) {
      out.x.push(place(ghosts, i, 0)); out.y.push(place(ghosts, i, 1)); out.z.push(place(ghosts, i, 2));
    }
    return out;
  }

  function rays(f, m) {
    const end = [0, 1, 2].map(axis => place(measured, f * M + m, axis));
    return end[0] === null ? {x: [], y: [], z: []} : lines(measuredWith(f, m).map(c => [c.at, end]));
  }

  function spaceTraces() {
    const base = {type: "scatter3d", hoverinfo: "skip", showlegend: false};
    const line = (xyz, stroke, thick, more = {}) => ({...base, ...xyz, mode: "lines", line: {color: stroke, width: thick}, connectgaps: false, ...more});
    const f = now.frame, m = now.marker, empty = {x: [], y: [], z: []};
    return [
      line(boxLines(), colour("orange"), 2),
      line(cameraLines(), colour("ink"), 2),
      {...base, x: raw.cameras.map(c => c.at[0]), y: raw.cameras.map(c => c.at[1]), z: raw.cameras.map(c => c.at[2]), mode: "text",
        text: raw.cameras.map(c => c.name), textposition: "top center", textfont: {color: colour("ink"), size: 11}},
      line(truth ? trail(truth, m, 0, F) : empty, colour("muted"), 6, {opacity: 0.4}),
      line(trail(measured, m, 0, F), colour("blue"), 3),
      {...base, ...(truth ? points(truth, f) : empty), mode: "markers", marker: {symbol: "circle-open", size: narrow ? 4 : 6, color: colour("muted")}},
      {...base, ...points(measured, f), mode: "markers", hoverinfo: "text", hovertext: hover(f), marker: {
        size: narrow ? 3 : 4, color: error ? colours(f) : colour("blue"), cmin: 0, cmax: top, colorscale: "Viridis", showscale: !!error,
        colorbar: {thickness: 10, outlinewidth: 0, tickfont: {color: colour("muted")}, ...(narrow ?
          {title: {text: "error [mm]", side: "top", font: {color: colour("muted")}}, orientation: "h", len: 0.8, y: 0, yanchor: "bottom", ypad: 2} :
          {title: {text: "error [mm]", side: "right", font: {color: colour("muted")}}, len: 0.7, x: 1, xpad: 4})}}},
      {...base, ...ghostPoints(f), mode: "markers", hoverinfo: "text", hovertext: "ghost: no marker is here", marker: {symbol: "x", size: 5, color: colour("vermilion")}},
      line(rays(f, m), colour("sky"), 2),
      {...base, ...chosenPoint(f, m), mode: "markers", marker: {symbol: "circle-open", size: 14, color: colour("vermilion"), line: {width: 2}}},
    ];
  }

  const colours = f => Array.from({length: M}, (_, m) => distanceMm(f * M + m));
  const hover = f => raw.names.map((name, m) => error ? `${name}: ${figure(distanceMm(f * M + m))} mm` : name);
  function chosenPoint(f, m) {
    const table = place(measured, f * M + m, 0) === null && truth ? truth : measured;
    return {x: [place(table, f * M + m, 0)], y: [place(table, f * M + m, 1)], z: [place(table, f * M + m, 2)]};
  }

  function spaceLayout() {
    const all = [...raw.box, ...raw.cameras.map(c => c.at), raw.low, raw.low.map((v, k) => v + raw.step[k] * 65534)];
    const axis = (k, name) => {
      const low = Math.min(...all.map(p => p[k])), high = Math.max(...all.map(p => p[k])), room = 0.04 * (high - low);
      return {title: {text: name}, range: [low - room, high + room], color: colour("muted"), gridcolor: colour("grid"),
        zeroline: false, showspikes: false, showbackground: false, tickfont: {size: 10}};
    };
    return {paper_bgcolor: "rgba(0,0,0,0)", margin: {l: 0, r: 0, t: 0, b: 0}, uirevision: "kept", hovermode: "closest",
      scene: {xaxis: axis(0, "x [m]"), yaxis: axis(1, "y [m]"), zaxis: axis(2, "z [m]"), aspectmode: "data", dragmode: "turntable", uirevision: "kept",
        camera: {eye: {x: far, y: -far, z: 0.55 * far}, center: {x: 0, y: 0, z: -0.13}}}};
  }

  /* ---- plots over time; null where there is no sample, so that no line crosses a gap ---- */
  const over = (f, table, m, axis) => place(table, f * M + m, axis);
  function markerTraces(m) {
    const traces = [], frames = Array.from({length: F}, (_, f) => f), t = Array.from(time);
    ["blue", "orange", "green"].forEach((name, axis) => {
      const known = frames.map(f => over(f, truth || measured, m, axis)).filter(v => v !== null);
      const mean = known.length ? known.reduce((a, b) => a + b, 0) / known.length : 0;
      const from = table => frames.map(f => { const v = over(f, table, m, axis); return v === null ? null : v - mean; });
      const common = {type: "scatter", mode: "lines", x: t, connectgaps: false, hoverinfo: "x+y"};
      if (truth) traces.push({...common, y: from(truth), line: {color: colour(name), width: 6}, opacity: 0.28, showlegend: false, hoverinfo: "skip"});
      traces.push({...common, y: from(measured), name: "xyz"[axis], line: {color: colour(name), width: 1.5}});
      if (error) traces.push({...common, y: frames.map(f => errorMm(f * M + m, axis)), yaxis: "y2", showlegend: false, line: {color: colour(name), width: 1.2}});
    });
    return traces;
  }

  /* spans of the chosen marker without a sample: [first, last, state] */
  function gaps(m) {
    const found = [];
    for (let f = 0; f < F; f++) {
      const s = state[f * M + m];
      if (s === FOUND) continue;
      const last = found[found.length - 1];
      if (last && last[1] === f - 1 && last[2] === s) last[1] = f; else found.push([f, f, s]);
    }
    return found;
  }

  const half = F > 1 ? (time[F - 1] - time[0]) / (F - 1) / 2 : 0.5;
  const cursor = () => ({type: "line", xref: "x", yref: "paper", x0: time[now.frame], x1: time[now.frame], y0: 0, y1: 1, line: {color: colour("ink"), width: 1.5}});
  const gapShapes = m => gaps(m).slice(0, 300).map(([a, b, s]) => ({type: "rect", xref: "x", yref: "paper", y0: 0, y1: 1, layer: "below",
    x0: time[a] - half, x1: time[b] + half, line: {width: 0}, opacity: 0.25, fillcolor: s === MISSED ? colour("vermilion") : colour("muted")}));
  const axisStyle = (title, more = {}) => ({title: {text: title, font: {size: 12}}, color: colour("muted"), gridcolor: colour("grid"), zeroline: false, ...more});
  function timeLayout(more) {
    return {paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: {color: colour("muted"), size: 11}, margin: {l: 58, r: 12, t: 22, b: 36},
      xaxis: axisStyle("time [s]", {range: [time[0] - half, time[F - 1] + half], anchor: more.yaxis2 ? "y2" : "y"}), hovermode: "closest", dragmode: "zoom",
      legend: {orientation: "h", x: 1, xanchor: "right", y: 1.0, yanchor: "bottom"}, ...more};
  }
  const markerLayout = m => timeLayout({shapes: [cursor(), ...gapShapes(m)],
    yaxis: axisStyle("from its mean [m]", error ? {domain: [0.46, 1]} : {}), ...(error ? {yaxis2: axisStyle("difference [mm]", {domain: [0, 0.38]})} : {})});
  const allTraces = () => [{type: "scatter", mode: "lines", x: Array.from(time), y: Array.from(rms, v => Number.isFinite(v) ? v : null), connectgaps: false,
    name: "rms of all markers", line: {color: colour("blue"), width: 1.5}, showlegend: false, hoverinfo: "x+y"}];
  function allLayout() {
    const shapes = [cursor()];
    if (raw.limit_mm !== null) shapes.push({type: "line", xref: "paper", x0: 0, x1: 1, y0: raw.limit_mm, y1: raw.limit_mm, line: {color: colour("vermilion"), width: 1.5, dash: "dot"}});
    const largest = Math.max(...Array.from(rms).filter(Number.isFinite), raw.limit_mm || 0, 1e-9);
    return timeLayout({shapes, showlegend: false, yaxis: axisStyle("rms of all [mm]", {range: [0, 1.08 * largest]})});
  }

  /* ---- images ---- */
  const NS = "http://www.w3.org/2000/svg";
  const views = [...document.querySelectorAll("#playback .view")].map(figure => {
    const overlay = document.createElementNS(NS, "svg");
    overlay.setAttribute("aria-hidden", "true");
    figure.querySelector(".frame").append(overlay);
    const button = figure.querySelector(".frame");
    button.tabIndex = 0;
    button.setAttribute("role", "button");
    button.setAttribute("aria-label", `Enlarge camera ${figure.dataset.camera}`);
    const enlarge = () => figure.classList.toggle("large");
    button.addEventListener("click", enlarge);
    button.addEventListener("keydown", event => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); enlarge(); } });
    return {figure, overlay, image: figure.querySelector("img"), when: figure.querySelector(".when"), camera: figure.dataset.camera};
  });
  let shownSet = null;

  function nearestSet(f) {
    let best = null;
    for (const one of sets) if (best === null || Math.abs(one.at - f) < Math.abs(best.at - f)) best = one;
    return best;
  }

  function showImages(f) {
    const set = nearestSet(f);
    if (set === null || set === shownSet) return;
    shownSet = set;
    for (const view of views) {
      const one = set.images[view.camera];
      view.figure.classList.toggle("absent", !one);
      view.overlay.replaceChildren();
      view.when.textContent = one ? `${time[set.at].toFixed(2)} s, ${one.d.length} detections` : "no image";
      if (!one) continue;
      view.image.src = "data:image/webp;base64," + one.src;
      view.image.alt = `Image of camera ${view.camera} with ${one.d.length} detections`;
      view.overlay.setAttribute("viewBox", `0 0 ${one.size[0]} ${one.size[1]}`);
      const least = one.size[0] / 90;
      for (let i = 0; i < one.d.length; i++) {
        const ring = document.createElementNS(NS, "circle");
        ring.setAttribute("cx", one.xy[2 * i] / 16);
        ring.setAttribute("cy", one.xy[2 * i + 1] / 16);
        ring.setAttribute("r", Math.max(1.1 * one.d[i] / 16, least));
        view.overlay.append(ring);
      }
    }
  }

  /* ---- one instant, one marker ---- */
  const plots = {space: webgl, of_marker: true, of_all: !!rms};
  const restyle = (trace, xyz, more = {}) => Plotly.restyle("space", {x: [xyz.x], y: [xyz.y], z: [xyz.z], ...more}, [trace]);

  function showSpace() {
    if (!webgl) return;
    const f = now.frame, m = now.marker, node = $("space"), data = node.data;
    const set = (trace, xyz) => Object.assign(data[trace], xyz);
    if (truth) set(TRUE, points(truth, f));
    set(MEASURED, {...points(measured, f), hovertext: hover(f)});
    if (error) data[MEASURED].marker.color = colours(f);
    set(GHOSTS, ghostPoints(f));
    set(RAYS, rays(f, m));
    set(CHOSEN, chosenPoint(f, m));
    Plotly.redraw(node);
  }

  function readout() {
    const f = now.frame, m = now.marker, i = f * M + m, cameras = measuredWith(f, m).map(c => c.name);
    const parts = [raw.names[m]];
    if (state[i] === FOUND) {
      if (error) parts.push(`error ${figure(distanceMm(i))} mm`);
      if (used) parts.push(cameras.length ? `measured by ${cameras.length} of ${C} cameras: ${cameras.join(", ")}` : "cameras not known");
    } else parts.push(state[i] === MISSED ? "could be seen, and was not measured" : truth ? "hidden: fewer than two cameras could see it" : "no sample");
    $("readout").textContent = parts.join("; ");
  }

  function show(frame) {
    now.frame = Math.max(0, Math.min(F - 1, Math.round(frame)));
    $("time").value = now.frame;
    $("clock").textContent = `${time[now.frame].toFixed(3)} s`;
    $("time").setAttribute("aria-valuetext", `${time[now.frame].toFixed(2)} seconds`);
    showSpace();
    for (const id of ["of_marker", "of_all"])
      if (plots[id]) Plotly.relayout(id, {"shapes[0].x0": time[now.frame], "shapes[0].x1": time[now.frame]});
    showImages(now.frame);
    readout();
  }

  function choose(marker) {
    now.marker = Math.max(0, Math.min(M - 1, Math.round(marker)));
    $("marker").value = now.marker;
    Plotly.react("of_marker", markerTraces(now.marker), markerLayout(now.marker), config);
    if (webgl) {
      if (truth) restyle(TRUE_TRAIL, trail(truth, now.marker, 0, F));
      restyle(TRAIL, trail(measured, now.marker, 0, F));
    }
    for (const row of document.querySelectorAll("[data-marker]"))
      row.closest("tr").classList.toggle("chosen", +row.dataset.marker === now.marker);
    show(now.frame);
  }

  function setLayer(name, on) {
    layers[name] = on;
    if (webgl) Plotly.restyle("space", {visible: on}, layerOf[name]);
  }

  const config = {displaylogo: false, responsive: true, showLink: false, plotlyServerURL: "", modeBarButtonsToRemove: ["toImage", "sendDataToCloud", "lasso2d", "select2d"],
    displayModeBar: false};

  function draw() {
    if (webgl) Plotly.react("space", spaceTraces(), spaceLayout(), {...config, scrollZoom: !narrow});
    Plotly.react("of_marker", markerTraces(now.marker), markerLayout(now.marker), config);
    if (rms) Plotly.react("of_all", allTraces(), allLayout(), config);
    for (const [name, on] of Object.entries(layers)) setLayer(name, on);
  }

  let started = 0, startedAt = 0;
  function play(on) {
    now.playing = on;
    $("play").textContent = on ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", String(on));
    if (!on) return;
    if (now.frame >= F - 1) now.frame = 0;
    started = performance.now();
    startedAt = time[now.frame];
    requestAnimationFrame(step);
  }
  function step(clock) {
    if (!now.playing) return;
    const at = startedAt + (clock - started) / 1000 * +$("speed").value;
    let f = now.frame;
    while (f < F - 1 && time[f + 1] <= at) f++;
    if (f !== now.frame) show(f);
    if (f >= F - 1) play(false); else requestAnimationFrame(step);
  }

  /* ---- begin ---- */
  for (const part of document.querySelectorAll("#playback [data-needs-js]")) part.hidden = false;
  document.documentElement.classList.add("plays");
  if (!webgl) { $("space").hidden = true; document.documentElement.classList.add("no-webgl"); }
  now.frame = +$("time").value;
  now.marker = raw.first;
  for (const box of document.querySelectorAll("[data-layer]")) {
    layers[box.dataset.layer] = box.checked;
    box.addEventListener("change", () => setLayer(box.dataset.layer, box.checked));
  }
  draw();
  choose(now.marker);
  $("time").addEventListener("input", () => { play(false); show(+$("time").value); });
  $("marker").addEventListener("change", () => choose(+$("marker").value));
  $("speed").addEventListener("change", () => { if (now.playing) play(true); });
  $("play").addEventListener("click", () => play(!now.playing));
  for (const button of document.querySelectorAll("[data-marker]"))
    button.addEventListener("click", () => { choose(+button.dataset.marker); $("playback").scrollIntoView({behavior: "smooth"}); });
  if (webgl) $("space").on("plotly_click", event => { const p = event.points[0]; if (p.curveNumber === MEASURED) setTimeout(() => choose(p.pointNumber)); });
  for (const id of ["of_marker", "of_all"])
    if (plots[id]) $(id).on("plotly_click", event => {
      const t = event.points[0].x;
      let best = 0;
      for (let f = 0; f < F; f++) if (Math.abs(time[f] - t) < Math.abs(time[best] - t)) best = f;
      setTimeout(() => { play(false); show(best); });
    });
  matchMedia("(prefers-color-scheme:dark)").addEventListener("change", () => { draw(); choose(now.marker); });
  window.moscaPlayer = {show, choose, play, now, sets, get shownSet() { return shownSet; }};
})();
