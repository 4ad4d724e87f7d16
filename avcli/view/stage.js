// The map and the camera's picture at one moment.

const SVG = "http://www.w3.org/2000/svg", PX = 100;  // px a metre on the map
function add(parent, name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}
const onMap = ([x, y]) => [PX * (x - run.extent[0]), PX * (run.extent[3] - y)];
const path = (points, place = onMap) => points.map(place).filter(p => p).map((p, i) => `${i ? "L" : "M"}${p[0].toFixed(1)} ${p[1].toFixed(1)}`).join("");

function drawRoom() {
  const svg = $("room"), [x0, x1, y0, y1] = run.extent, margin = 0.06 * Math.max(x1 - x0, y1 - y0) * PX + 12;
  const width = PX * (x1 - x0) + 2 * margin, height = PX * (y1 - y0) + 2 * margin;
  svg.setAttribute("viewBox", `${-margin} ${-margin} ${width} ${height}`);
  svg.replaceChildren();
  const shownWidth = Math.min(svg.clientWidth || 500, (svg.clientHeight || 500) * width / height), unit = width / shownWidth;
  svg.style.setProperty("--text", `${12.5 * unit}px`);
  svg.unit = unit;
  const [wx, wy] = run.room || [x1, y1], corner = onMap([0, wy]);
  if (run.room) {
    const clip = add(add(svg, "defs", {}), "clipPath", { id: "inside" });
    add(clip, "rect", { x: corner[0], y: corner[1], width: PX * wx, height: PX * wy });
    add(svg, "rect", { x: corner[0], y: corner[1], width: PX * wx, height: PX * wy, class: "floor" });
    if (run.camera) add(svg, "path", { d: path(run.camera.reach) + "Z", class: "reach", "clip-path": "url(#inside)", "data-layer": "view" });
    drawLearnt(svg);
    add(svg, "rect", { x: corner[0], y: corner[1], width: PX * wx, height: PX * wy, class: "wall", "stroke-width": 2.5 * unit });
    for (const [ax, ay, bx, by] of run.doors || []) {
      add(svg, "path", { d: path([[ax, ay], [bx, by]]), class: "door", "stroke-width": 6 * unit });
      const [u, v] = onMap([(ax + bx) / 2, (ay + by) / 2]);
      const inward = ax === bx ? [ax < wx / 2 ? 8 : -8, 4] : [0, ay < wy / 2 ? -8 : 16];
      add(svg, "text", { x: u + inward[0] * unit, y: v + inward[1] * unit, "text-anchor": ax !== bx ? "middle" : ax < wx / 2 ? "start" : "end", class: "small" }, "door");
    }
  }
  for (const piece of run.furniture || []) {
    add(svg, "path", { d: path(piece.outline) + "Z", class: "furniture", "stroke-width": unit });
    const xs = piece.outline.map(p => p[0]), ys = piece.outline.map(p => p[1]);
    const [u, v] = onMap([(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2]);
    if (PX * (Math.max(...xs) - Math.min(...xs)) > 44 * unit) add(svg, "text", { x: u, y: v + 4 * unit, "text-anchor": "middle", class: "small" }, piece.name);
  }
  (run.microphones || []).forEach((place, k) => {
    const [u, v] = onMap(place), right = place[0] > wx / 2;
    add(svg, "circle", { cx: u, cy: v, r: 5 * unit, class: "fixture", "stroke-width": 1.5 * unit });
    add(svg, "text", { x: u + (right ? -9 : 9) * unit, y: v + 4.5 * unit, "text-anchor": right ? "end" : "start", class: "small" }, k + 1);
  });
  if (run.camera) {
    const [u, v] = onMap(run.camera.position), s = 7 * unit;
    add(svg, "path", { d: `M${u - s} ${v - 0.7 * s}h${2 * s}v${1.4 * s}h${-2 * s}zM${u + 0.4 * s} ${v}a${0.4 * s} ${0.4 * s} 0 1 0 ${-0.8 * s} 0a${0.4 * s} ${0.4 * s} 0 1 0 ${0.8 * s} 0`, class: "fixture", "stroke-width": 1.5 * unit });
  }
  const long = wx - 0 > 8 ? 2 : 1, [u, v] = onMap([x0, y0]);  // a scale below the room
  add(svg, "path", { d: `M${u} ${v + 10 * unit}h${PX * long}`, class: "wall", "stroke-width": 2 * unit });
  add(svg, "text", { x: u + PX * long + 6 * unit, y: v + 14 * unit, class: "small" }, `${long} m`);
  svg.moving = add(svg, "g", {});
}
function drawLearnt(svg) {
  if (!run.learnt || !layers.exits) return;
  const [x0, y0, x1, y1] = run.learnt.area, cells = run.learnt.exits, dx = (x1 - x0) / cells.length, dy = (y1 - y0) / cells[0].length;
  const most = Math.max(2, ...cells.flat());
  cells.forEach((column, i) => column.forEach((value, j) => {
    const strength = Math.log(Math.max(1, value)) / Math.log(most);
    if (strength < 0.08) return;
    const [u, v] = onMap([x0 + i * dx, y0 + (j + 1) * dy]);
    add(svg, "rect", { x: u, y: v, width: PX * dx + 0.5, height: PX * dy + 0.5, class: "learnt", opacity: (0.75 * strength).toFixed(2) });
  }));
}

const spread = row => row[COVARIANCE + 2] === undefined || row[COVARIANCE] === null ? null : row.slice(COVARIANCE, COVARIANCE + 3);
function hue(k) { return PALETTE[dark.matches ? "dark" : "light"][k % PALETTE.light.length]; }

function drawMoment() {
  const svg = $("room"), group = svg.moving, unit = svg.unit, t = run.ticks[now];
  group.replaceChildren();
  const shown = shownTrackers();
  if (layers.trails) {
    for (const one of shown) for (const [id, points] of trails(one, t))
      add(group, "path", { d: path(points), class: "trail", stroke: hue(one.labels.get(id)), "stroke-width": 2.5 * unit, "stroke-dasharray": one === tracker ? "" : trackerLook(one).dash.map(v => v * unit).join(" ") });
    if (run.truth && layers.truth) for (const points of trails(run.truth, t).values()) add(group, "path", { d: path(points), class: "truth", "stroke-width": 1.2 * unit, "stroke-dasharray": `${2 * unit} ${4 * unit}` });
  }
  if (run.truth && layers.truth) for (const person of objectsAt(run.truth, t)) {
    const [u, v] = onMap([person[X], person[Y]]);
    add(group, "circle", { cx: u, cy: v, r: 13 * unit, class: "truth", "stroke-width": 2 * unit, "data-truth": person[ID] });
    if (person[SPEAKING] > 0.5) add(group, "circle", { cx: u, cy: v, r: 18 * unit, class: "voice", "stroke-width": 3 * unit });
  }
  for (const sensor of run.sensors) if (layers[sensor.name]) for (const found of objectsAt(sensor, t)) drawDetection(group, sensor, found, unit);
  const taken = [];
  for (const one of shown) for (const track of objectsAt(one, t)) {
    const [u, v] = onMap([track[X], track[Y]]), color = hue(one.labels.get(track[ID])), around = spread(track), predicted = track[OBSERVED] === 0;
    if (layers.ellipses && around) add(group, "path", { d: path(ellipse([track[X], track[Y]], around)) + "Z", stroke: color, fill: color, class: "spread", "stroke-width": 1.2 * unit });
    if (one === tracker) {
      add(group, "circle", { cx: u, cy: v, r: 7.5 * unit, fill: predicted ? "var(--card)" : color, stroke: color, "stroke-width": 2 * unit, "data-track": track[ID] });
      if (!run.truth && track[SPEAKING] > 0.5) add(group, "circle", { cx: u, cy: v, r: 13 * unit, class: "voice", "stroke-width": 3 * unit });
      let down = -12 * unit;
      while (taken.some(([a, b]) => Math.abs(a - u) < 26 * unit && Math.abs(b - v - down) < 13 * unit)) down -= 13 * unit;
      taken.push([u, v + down]);
      add(group, "text", { x: u + 10 * unit, y: v + down, class: "label ink", "stroke-width": 3 * unit }, track[ID]);
    } else mark(group, trackerLook(one).shape, u, v, 6 * unit, { fill: "none", stroke: trackerLook(one).color, "stroke-width": 2 * unit, "data-other": track[ID] });
  }
}
function mark(group, shape, u, v, s, look) {
  const d = { square: `M${u - s} ${v - s}h${2 * s}v${2 * s}h${-2 * s}z`, diamond: `M${u} ${v - 1.3 * s}l${1.3 * s} ${1.3 * s}l${-1.3 * s} ${1.3 * s}l${-1.3 * s} ${-1.3 * s}z`, triangle: `M${u} ${v - 1.2 * s}l${1.1 * s} ${2 * s}h${-2.2 * s}z`, cross: `M${u - s} ${v - s}l${2 * s} ${2 * s}M${u - s} ${v + s}l${2 * s} ${-2 * s}`, plus: `M${u - s} ${v}h${2 * s}M${u} ${v - s}v${2 * s}` }[shape];
  return add(group, "path", { d, ...look });
}
function drawDetection(group, sensor, found, unit) {
  const heard = sensor.sensor === "microphones";
  if (found[DIRECTION] && found[ORIGIN]) {
    const [ox, oy] = found[ORIGIN], [dx, dy] = found[DIRECTION];
    add(group, "path", { d: path([[ox, oy], [ox + 20 * dx, oy + 20 * dy]]), class: "heard", "stroke-width": 1.5 * unit, "stroke-dasharray": `${5 * unit} ${4 * unit}`, "clip-path": run.room ? "url(#inside)" : "" });
  }
  if (found[0] == null) return;
  const [u, v] = onMap([found[0], found[1]]);
  if (layers.ellipses && found[SPREAD + 2] > 0 && heard) add(group, "path", { d: path(ellipse([found[0], found[1]], found.slice(SPREAD, SPREAD + 3))) + "Z", class: "heardspread", "stroke-width": unit });
  mark(group, heard ? "cross" : "plus", u, v, 6 * unit, { class: heard ? "heard" : "detection", "stroke-width": 2 * unit, "data-found": sensor.name });
}

function drawPicture() {
  const box = $("picture"), t = run.ticks[now];
  const picture = run.film && run.film.jpegs ? run.film.t : null, at = picture ? rowAt(run.film.rows, t) : -1;
  box.hidden = !(run.camera || run.film);
  $("stage").classList.toggle("pictured", !box.hidden);
  if (box.hidden) return;
  const size = run.camera ? run.camera.size : [1920, 1080];
  box.style.aspectRatio = `${size[0]} / ${size[1]}`;
  const image = $("frame");
  image.hidden = at < 0;
  if (at >= 0 && image.dataset.at !== `${run.name}/${at}`) { image.src = run.film.jpegs[at]; image.dataset.at = `${run.name}/${at}`; }
  const svg = $("boxes");
  svg.setAttribute("viewBox", `0 0 ${size[0]} ${size[1]}`);
  svg.replaceChildren();
  if (!run.camera) return;
  const unit = size[0] / (box.clientWidth || 640), seen = place => project(run.camera, place), group = add(svg, "g", {});
  svg.style.setProperty("--text", `${13 * unit}px`);
  const floor = ([x, y]) => seen([x, y, 0]);
  for (const sensor of run.sensors) if (layers[sensor.name]) for (const found of objectsAt(sensor, t)) {
    if (found[BOX]) { const [x0, y0, x1, y1] = found[BOX]; add(group, "rect", { x: x0, y: y0, width: x1 - x0, height: y1 - y0, class: "seen", "stroke-width": 1.5 * unit, "stroke-dasharray": `${5 * unit} ${3 * unit}`, "data-found": sensor.name }); }
    else if (sensor.sensor === "microphones" && found[0] != null) {
      const place = seen([found[0], found[1], found[2] ?? MOUTH_M]);
      if (place) { mark(group, "cross", ...place, 7 * unit, { class: "heard", "stroke-width": 3 * unit, "data-found": sensor.name }); add(group, "circle", { cx: place[0], cy: place[1], r: 11 * unit, class: "heard", "stroke-width": 1.5 * unit }); }
    }
  }
  if (run.truth && layers.truth) for (const person of objectsAt(run.truth, t)) {
    const foot = floor([person[X], person[Y]]);
    if (foot) add(group, "circle", { cx: foot[0], cy: foot[1], r: 8 * unit, class: "true", "stroke-width": 2 * unit, "data-truth": person[ID] });
  }
  for (const one of shownTrackers()) {
    const dash = one === tracker ? "" : trackerLook(one).dash.map(v => v * unit).join(" ");
    if (layers.trails) for (const [id, points] of trails(one, t)) add(group, "path", { d: path(points, floor), class: "trail", stroke: hue(one.labels.get(id)), "stroke-width": 3 * unit, "stroke-dasharray": dash });
    for (const track of objectsAt(one, t)) drawTrack(group, one, track, seen, unit, dash);
  }
}
function drawTrack(group, one, track, seen, unit, dash) {
  const color = hue(one.labels.get(track[ID])), foot = seen([track[X], track[Y], 0]), head = seen([track[X], track[Y], BODY_M]), around = spread(track);
  if (layers.ellipses && around) add(group, "path", { d: path(ellipse([track[X], track[Y]], around), p => seen([p[0], p[1], 0])) + "Z", class: "spread", stroke: color, fill: color, "stroke-width": 1.2 * unit });
  if (foot && head) add(group, "path", { d: `M${foot.join(" ")}L${head.join(" ")}`, stroke: color, "stroke-width": (one === tracker ? 3 : 2) * unit, "stroke-dasharray": dash, class: "trail" });
  if (foot) add(group, "circle", { cx: foot[0], cy: foot[1], r: 4.5 * unit, fill: track[OBSERVED] === 0 ? "none" : color, stroke: color, "stroke-width": 2 * unit, "data-track": track[ID] });
  const at = head || foot;
  if (!at || one !== tracker) return;
  const speaks = track[SPEAKING] > 0.5, text = `${track[ID]}${speaks ? " speaks" : ""}`, wide = (9 + 7.4 * text.length) * unit;
  const [w, h] = run.camera.size, u = Math.min(w - wide - 2 * unit, Math.max(2 * unit, at[0] - wide / 2)), v = Math.min(h - 20 * unit, Math.max(2 * unit, at[1] - 10 * unit));
  add(group, "rect", { x: u, y: v, width: wide, height: 19 * unit, rx: 5 * unit, class: speaks ? "chip speaking" : "chip", stroke: color, "stroke-width": 2 * unit });
  add(group, "text", { x: u + wide / 2, y: v + 14 * unit, "text-anchor": "middle", class: "chiptext" }, text);
}

function drawPeople() {
  const t = run.ticks[now], items = [];
  const say = (mark, text, speaks, beam) => items.push({ mark, text, speaks, beam });
  if (run.truth && layers.truth) for (const person of objectsAt(run.truth, t))
    say({ border: "2px solid var(--ink)" }, `person ${person[ID]}: ${person[X].toFixed(2)}, ${person[Y].toFixed(2)} m${person[SPEAKING] > 0.5 ? ", speaks" : ""}`, person[SPEAKING] > 0.5);
  if (tracker && layers.tracks) for (const track of objectsAt(tracker, t)) {
    const around = spread(track), sure = around ? ` ± ${(100 * Math.sqrt((around[0] + around[2]) / 2)).toFixed(0)} cm` : "";
    say({ background: hue(tracker.labels.get(track[ID])) }, `track ${track[ID]}: ${track[X].toFixed(2)}, ${track[Y].toFixed(2)} m${sure}${track[OBSERVED] === 0 ? ", not seen now" : ""}${!run.truth && track[SPEAKING] > 0.5 ? ", speaks" : ""}`, !run.truth && track[SPEAKING] > 0.5, beamAt(track[ID]));
  }
  const list = $("people");  // the items stay, so that a button keeps the focus while the run plays
  while (list.children.length > items.length) list.lastChild.remove();
  items.forEach(({ mark, text, speaks, beam }, i) => {
    let item = list.children[i];
    if (!item || (item.firstChild.tagName === "BUTTON") !== Boolean(beam)) {
      const fresh = document.createElement("li"), inner = document.createElement(beam ? "button" : "span");
      inner.append(document.createElement("i"), document.createElement("span"));
      if (beam) { inner.type = "button"; inner.addEventListener("click", () => listenTo(heard === inner.beam ? run.sound : inner.beam)); }
      fresh.append(inner);
      if (item) item.replaceWith(fresh); else list.append(fresh);
      item = fresh;
    }
    const inner = item.firstChild;
    inner.firstChild.removeAttribute("style");
    Object.assign(inner.firstChild.style, mark);
    inner.lastChild.textContent = text;
    item.classList.toggle("speaks", speaks);
    if (beam) { inner.beam = beam; inner.setAttribute("aria-pressed", heard === beam); inner.title = "listen at this track"; }
  });
}
