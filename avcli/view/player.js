// One clock for everything: playing, keys, layers, the address, and the live run.
const data = window.RECORDED || JSON.parse($("data").textContent);
const PALETTE = {
  light: ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195", "#8C564B"],
  dark: ["#56B4E9", "#FF8F4D", "#3CCB9C", "#F0A6CF", "#FFC24D", "#9BD6FF", "#BC9BDB", "#D0A393"],
};
const dark = matchMedia("(prefers-color-scheme: dark)");
const layers = { truth: true, tracks: true, trails: true, ellipses: true, exits: true };
let run, tracker, heard = null, compare = false, now = 0, view = [0, 1], origin = 0, playing = 0, speed = 1, follow = data.live != null, shownLanes = [];

function $(id) { return document.getElementById(id); }
const inks = {};
function ink(name) { return inks[name] || (inks[name] = getComputedStyle(document.documentElement).getPropertyValue(name).trim()); }
const trackers = () => run.streams.filter(one => one.kind === "tracks");
const shownTrackers = () => layers.tracks ? trackers().filter(one => compare || one === tracker).sort((a, b) => (a === tracker) - (b === tracker)) : [];
const subject = () => run.truth || tracker || { kind: "tracks", rows: [], labels: new Map(), step: 0.1 };
const end = () => run.ticks.length ? run.ticks[run.ticks.length - 1] : 0;
function trackerLook(one) {
  const k = trackers().indexOf(one);
  return { color: hue(k), dash: [[], [7, 4], [2, 4], [9, 3, 2, 3], [12, 5]][k % 5], shape: ["square", "diamond", "triangle", "plus", "cross"][k % 5] };
}

// --- what there is ---------------------------------------------------------------------------------------------------

function gather(one) {
  one.streams.forEach(prepare);
  one.truth = one.streams.find(s => s.kind === "truth");
  one.sensors = one.streams.filter(s => s.kind === "detections");
  if (one.film && one.film.t) one.film.rows = one.film.t.map(t => [t]);
  const times = new Set(one.streams.flatMap(s => s.rows.map(row => row[0])));
  if (!times.size && one.film) for (const t of one.film.t || []) times.add(t);
  one.ticks = [...times].sort((a, b) => a - b).filter((t, i, all) => !i || t - all[i - 1] > 2e-3);
  measure(one);
}
function measure(one) {
  const points = [...(one.microphones || []), ...(one.camera ? [one.camera.position] : []), ...(one.room ? [[0, 0], one.room] : [])];
  const limit = one.room ? p => [Math.max(-0.5 * one.room[0], Math.min(1.5 * one.room[0], p[0])), Math.max(-0.5 * one.room[1], Math.min(1.5 * one.room[1], p[1]))] : p => p;
  let box = [Infinity, -Infinity, Infinity, -Infinity];
  const take = ([x, y]) => { box = [Math.min(box[0], x), Math.max(box[1], x), Math.min(box[2], y), Math.max(box[3], y)]; };
  points.forEach(take);
  for (const s of one.streams) for (const [, row] of s.rows) for (const item of row) {
    const place = s.kind === "detections" ? item : item.slice(X, Y + 1);
    if (place[0] != null) take(limit(place));  // a wild detection far outside must not shrink the room to a speck
  }
  one.extent = box[0] < box[1] ? box : [0, 1, 0, 1];
}

// --- the moment -------------------------------------------------------------------------------------------------------

function show(frame) {
  if (!run.ticks.length) { $("clock").textContent = "no records"; drawPicture(); return; }
  now = Math.max(0, Math.min(run.ticks.length - 1, frame));
  const t = run.ticks[now];
  $("slider").value = now;
  $("clock").textContent = clock(t);
  $("slider").setAttribute("aria-valuetext", clock(t));
  if (t < view[0] || t > view[1]) { const wide = view[1] - view[0]; look(t - 0.05 * wide, t + 0.95 * wide); }
  drawMoment();
  drawPicture();
  drawPeople();
  sayHeard();
  for (const id of ["timeline", "sound", "error"]) {
    const node = $(id), line = node.nextElementSibling;
    if (node.at) line.style.transform = `translateX(${node.at.x(t).toFixed(1)}px)`;
  }
}
function frameAt(t) {
  let low = 0, high = run.ticks.length - 1;
  while (low < high) { const middle = (low + high + 1) >> 1; if (run.ticks[middle] <= t + 1e-3) low = middle; else high = middle - 1; }
  return low < run.ticks.length - 1 && run.ticks[low + 1] - t < t - run.ticks[low] ? low + 1 : low;
}
function seek(t) { stop(); follow = false; show(frameAt(t)); cue(); remember(); }
function look(from, to) {
  const first = run.ticks[0] ?? 0, all = Math.max(0.2, end() - first), wide = Math.min(all, Math.max(0.5, to - from));
  from = Math.max(first, Math.min(end() - wide, from));
  view = [from, from + wide];
  drawCharts();
}
function zoom(factor) {
  const t = run.ticks[now] ?? 0, share = (t - view[0]) / (view[1] - view[0] || 1), wide = (view[1] - view[0]) * factor;
  look(t - share * wide, t + (1 - share) * wide);
  show(now);
}
function drawCharts() { drawLanes(); drawSound(); drawError(); drawScores(); }
function redraw() {
  for (const name in inks) delete inks[name];
  drawRoom();
  drawCharts();
  show(now);
}

// --- playing ----------------------------------------------------------------------------------------------------------

// What can be heard: the microphone, and the beams; and from when to when.
const sounds = () => [run.sound, ...(run.beams || [])].filter(one => one);
const lasts = source => [source.start, source.start + bytesOf(source).length * source.step];
const sounding = t => heard && heard.src && t >= lasts(heard)[0] && t < lasts(heard)[1] - 0.02;
function cue() {
  const t = run.ticks[now], film = run.film && run.film.src ? run.film : null;
  const set = (node, at) => { if (Math.abs(node.currentTime - at) > (playing ? 0.15 : 0.01)) node.currentTime = at; };
  if (film) set($("film"), Math.max(0, t - film.start + Math.min(0.05, 0.5 / film.rate)));
  if (sounding(t)) set($("speaker"), t - heard.start);
}
// Sound plays while it lasts: a beam is silent where its track is not there.
function keepSounding(t) {
  const speaker = $("speaker"), on = sounding(t);
  if (on && speaker.paused && !speaker.ended) { speaker.currentTime = t - heard.start; speaker.playbackRate = speed; speaker.play().catch(() => {}); }
  else if (!on && !speaker.paused) speaker.pause();
}
function stop() {
  stopStream();
  cancelAnimationFrame(playing);
  playing = 0;
  $("speaker").pause();
  $("film").pause();
  $("play").textContent = "Play";
}
function play() {
  if (playing) { stop(); remember(); return; }
  if (now >= run.ticks.length - 1 && !follow) show(0);
  $("play").textContent = "Pause";
  let t = run.ticks[now], before = performance.now();
  playing = 1;
  cue();
  if (run.film && run.film.src) { $("film").playbackRate = speed; $("film").play().catch(() => {}); }
  if (run.sound && run.sound.live) startStream(); else keepSounding(t);
  const advance = at => {
    t += speed * Math.min(0.5, (at - before) / 1000);
    before = at;
    const speaker = $("speaker");
    if (heard && !speaker.paused && speaker.readyState > 1) { const at = speaker.currentTime + heard.start; if (Math.abs(at - t) < 0.5) t = at; }
    if (stream) t = streamTime(); else keepSounding(t);
    let next = now;
    while (next < run.ticks.length - 1 && run.ticks[next + 1] <= t + 1e-3) next++;
    if (stream && run.ticks[next] > t) next = frameAt(t);
    if (next !== now) show(next);
    if (now >= run.ticks.length - 1 && !stream) return stop();
    playing = requestAnimationFrame(advance);
  };
  playing = requestAnimationFrame(advance);
}

// --- what is shown ----------------------------------------------------------------------------------------------------

function button(parent, name, text, pressed, changed) {
  const node = document.createElement("button");
  node.type = "button";
  node.dataset.name = name;
  node.append(...[].concat(text));
  node.setAttribute("aria-pressed", pressed);
  node.addEventListener("click", () => changed(node));
  parent.append(node);
  return node;
}
function press(parent, chosen) { for (const node of $(parent).querySelectorAll("button")) if (node.dataset.name in chosen) node.setAttribute("aria-pressed", chosen[node.dataset.name]); }
function chooseTracker(which) {
  tracker = which;
  press("trackers", Object.fromEntries(trackers().map(t => [t.name, t === which])));
  shownLanes = lanes(subject(), run.sensors, tracker);
  tell();
  drawCharts();
  show(now);
}
function setCompare(on) { compare = on; press("trackers", { "all together": on }); drawError(); show(now); }
// Listen to the microphone or to the beam at a track.
function tune(which) {
  heard = which;
  $("speaker").pause();
  if (heard && heard.src) $("speaker").src = heard.src; else $("speaker").removeAttribute("src");
  $("heard").value = sounds().indexOf(heard);
}
function listenTo(which) {
  tune(which);
  if (playing) keepSounding(run.ticks[now]);
  drawSound();
  show(now);
}
const beamAt = id => tracker && (run.beams || []).find(beam => beam.tracker === tracker.name && beam.id === id);
function sayHeard() {
  const where = heard && !heard.live && heard.id !== undefined && !sounding(run.ticks[now]) ? "; the track is not there now, so it is silent" : "";
  const text = heard ? `You hear ${heard.name}${heard.id === undefined ? "" : ": all microphones, steered at its path, with the other tracks damped"}${where}.${data.live != null && heard !== run.sound ? ` Drawn below: ${run.sound.name}.` : ""}` : data.live != null ? "No sound has come yet; --sound or audio records bring it." : "";
  if ($("hearing").textContent !== text) $("hearing").textContent = text;
  $("behind").textContent = !stream ? "" : stream.context.state === "suspended" ? "The browser holds the sound back; click into the page." : `Sound and picture are ${Math.max(0, soundEnd() - streamTime()).toFixed(1)} s behind the newest sound.`;
}
function chooseRun(which) {
  stop();
  run = which;
  $("run").value = data.runs.indexOf(run);
  const first = run.ticks[0] ?? 0, all = trackers();
  origin = first > 1e6 ? first : 0;
  tracker = all.find(t => tracker && t.name === tracker.name) || all[all.length - 1] || null;
  view = [first, Math.max(first + 0.2, end())];
  if (data.live != null) view[0] = Math.max(first, view[1] - 30);
  $("slider").max = Math.max(0, run.ticks.length - 1);
  shownLanes = lanes(subject(), run.sensors, tracker);
  about();
  controls();
  if (run.film && run.film.src) $("film").src = run.film.src; else $("film").removeAttribute("src");
  $("film").hidden = !(run.film && run.film.src);
  $("mute").hidden = $("hear").hidden = !sounds().length;
  tune(run.sound);
  tell();
  drawRoom();
  drawCharts();
  show(follow ? run.ticks.length - 1 : Math.min(now, Math.max(0, run.ticks.length - 1)));
}
function about() {
  const first = run.ticks[0] ?? 0, people = run.truth ? run.truth.labels.size : 0, plural = (n, one, more) => `${n} ${n === 1 ? one : more}`;
  const parts = [`${plural(run.ticks.length, "moment", "moments")} in ${clock(end() + origin - (origin || 0), 1)}`];
  if (run.truth) parts.push(plural(people, "person", "people"));
  else if (tracker) parts.push(plural(tracker.labels.size, "track", "tracks"));
  if (run.sound) parts.push(`sound of ${run.sound.name}${run.beams ? ` and of ${plural(run.beams.length, "beam", "beams")}` : ""}`);
  $("about").textContent = parts.join(", ") + (data.live != null ? "; live" : "");
}
function controls() {
  for (const box of [$("trackers"), $("layers")]) box.replaceChildren(box.querySelector("legend"));
  trackers().forEach((t, k) => {
    const score = run.scores && run.scores[t.name] && run.scores[t.name].score;
    button($("trackers"), t.name, score == null ? t.name : `${t.name}: HOTA ${percent(score)}`, t === tracker, () => chooseTracker(t)).title = k < 9 ? `key ${k + 1}` : "";
  });
  if (trackers().length > 1) button($("trackers"), "all together", "all together", compare, () => setCompare(!compare)).title = "key C";
  $("heard").replaceChildren(...sounds().map((one, i) => new Option(one.name, i)));
  const names = {};
  if (run.truth) names.truth = "truth";
  if (trackers().length) Object.assign(names, { tracks: "tracks", trails: "paths", ellipses: "95 % ellipses" });
  if (run.learnt) names.exits = "where people leave";
  for (const sensor of run.sensors) { names[sensor.name] = `${sensor.sensor === "microphones" ? "×" : "+"} ${sensor.name}`; if (!(sensor.name in layers)) layers[sensor.name] = true; }
  for (const name in names) button($("layers"), name, names[name], layers[name], node => {
    layers[name] = !layers[name];
    node.setAttribute("aria-pressed", layers[name]);
    if (name === "exits") drawRoom();
    show(now);
  });
}
function percent(value) { return (100 * value).toFixed(1); }
// The lanes in words, for whoever cannot see them.
function tell() {
  const by = new Map();
  for (const lane of shownLanes) { if (!by.has(lane.who)) by.set(lane.who, []); by.get(lane.who).push(lane); }
  const times = spans => spans.length > 8 ? `${spans.length} times, from ${clock(spans[0][0], 1)} to ${clock(spans[spans.length - 1][1], 1)}` : spans.map(([a, b]) => `${clock(a, 1)} to ${clock(b, 1)}`).join(", ") || "never";
  $("in-words").replaceChildren(...[...by].slice(0, 200).map(([who, own]) => {
    const item = document.createElement("li");
    item.textContent = `${who}: ${own.map(lane => `${lane.what} ${times(lane.spans)}`).join("; ")}`;
    return item;
  }));
}

// --- hands ------------------------------------------------------------------------------------------------------------

data.runs.forEach((one, i) => { gather(one); $("run").add(new Option(one.name, i)); });
$("run-choice").hidden = data.runs.length < 2;
$("run").addEventListener("change", () => chooseRun(data.runs[$("run").value]));
$("slider").addEventListener("input", () => { stop(); follow = false; show(+$("slider").value); cue(); });
$("slider").addEventListener("change", remember);
$("play").addEventListener("click", play);
$("speed").addEventListener("change", () => { speed = +$("speed").value; $("speaker").playbackRate = $("film").playbackRate = speed; });
$("mute").addEventListener("click", mute);
$("closer").addEventListener("click", () => zoom(0.5));
$("wider").addEventListener("click", () => zoom(2));
$("heard").addEventListener("change", () => listenTo(sounds()[$("heard").value]));
for (const id of ["room", "boxes"]) $(id).addEventListener("click", event => {
  const near = [...$(id).querySelectorAll("[data-track]")].map(node => {
    const box = node.getBoundingClientRect();
    return [Math.hypot(box.x + box.width / 2 - event.clientX, box.y + box.height / 2 - event.clientY), node];
  }).filter(([away]) => away < 28).sort((a, b) => a[0] - b[0]);
  if (!near.length || !sounds().length) return;
  const who = identity(near[0][1].dataset.track), beam = beamAt(who);
  if (beam) listenTo(heard === beam ? run.sound : beam);
  else $("hearing").textContent = `There is no beam at track ${who} of ${tracker.name}` + (run.beams ? `; those there are can be chosen beside “Hear”.` : "; avview makes beams with the sound of all microphones.");
});
const identity = text => { const known = [...tracker.labels.keys()]; return known.find(id => String(id) === text); };
function mute() { $("speaker").muted = !$("speaker").muted; if (stream) stream.gain.gain.value = $("speaker").muted ? 0 : 0.6 / stream.loudest; $("mute").textContent = $("speaker").muted ? "Sound off" : "Sound on"; }
function remember() {
  if (data.live != null || !run.ticks.length) return;
  const part = `t=${(run.ticks[now] - origin).toFixed(2)}` + (data.runs.length > 1 ? `&run=${encodeURIComponent(run.name)}` : "");
  try { history.replaceState(null, "", "#" + part); } catch { location.replace("#" + part); }
}
function recall() {
  const asked = new URLSearchParams(location.hash.slice(1)), named = data.runs.find(one => one.name === asked.get("run"));
  if (named && named !== run) chooseRun(named);
  const t = parseFloat(asked.get("t"));
  if (Number.isFinite(t)) { show(frameAt(t + origin)); cue(); }
}
for (const id of ["timeline", "sound", "error"]) {
  const node = $(id);
  node.addEventListener("pointerdown", event => { seek(id === "error" ? peakNear(node, event.clientX) : timeAt(node, event.clientX)); });
  node.addEventListener("pointermove", event => { if (event.buttons) seek(timeAt(node, event.clientX)); });
  node.addEventListener("wheel", event => { if (event.ctrlKey || event.shiftKey) { event.preventDefault(); zoom((event.deltaY || event.deltaX) > 0 ? 1.3 : 1 / 1.3); } }, { passive: false });
}
document.addEventListener("click", event => {  // after a click with a mouse the keys belong to the page again
  const node = event.target.closest && event.target.closest("button");
  if (node && event.detail) node.blur();
});
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  if (event.target.closest(".scroll") && event.key.startsWith("Arrow")) return;
  const move = { ArrowLeft: now - 1, ArrowRight: now + 1, Home: 0, End: run.ticks.length - 1 }[event.key];
  const second = { PageUp: -1, PageDown: 1 }[event.key];
  if (event.key === " " && !["BUTTON", "SUMMARY"].includes(event.target.tagName)) play();
  else if (move !== undefined && event.shiftKey && event.key.startsWith("Arrow")) seek(run.ticks[now] + Math.sign(move - now));
  else if (move !== undefined) { stop(); follow = false; show(move); cue(); remember(); }
  else if (second) seek(run.ticks[now] + 10 * second);
  else if (/^[1-9]$/.test(event.key) && trackers()[event.key - 1]) chooseTracker(trackers()[event.key - 1]);
  else if (event.key === "c" && trackers().length > 1) setCompare(!compare);
  else if (event.key === "m" && heard) mute();
  else if (event.key === "h" && sounds().length > 1) listenTo(sounds()[(sounds().indexOf(heard) + 1) % sounds().length]);
  else if (event.key === "+" || event.key === "=") zoom(0.5);
  else if (event.key === "-") zoom(2);
  else return;
  event.preventDefault();
});
let drawn = 0;
new ResizeObserver(() => { if (innerWidth !== drawn) { drawn = innerWidth; redraw(); } }).observe(document.body);
dark.addEventListener("change", redraw);
addEventListener("hashchange", recall);

// --- live -------------------------------------------------------------------------------------------------------------

function listen() {
  let stale = false;
  const source = new EventSource(`events?from=${data.live}`);
  source.onmessage = event => {
    const said = JSON.parse(event.data);
    if (said.ended) { source.close(); ended = true; $("about").textContent += "; the run has ended"; return; }
    if (said.stream) { run.streams.push(said.stream); prepare(said.stream); run.truth = run.streams.find(s => s.kind === "truth"); run.sensors = run.streams.filter(s => s.kind === "detections"); tracker = tracker || trackers()[0] || null; controls(); }
    if (said.row) {
      const stream = run.streams[said.to], last = stream.rows[stream.rows.length - 1];
      stream.rows.push(said.row);
      if (last && last[0] > said.row[0]) stream.rows.sort((a, b) => a[0] - b[0]);
      number(stream, said.row);
      const t = said.row[0];
      if (!run.ticks.length || t > end() + 2e-3) run.ticks.push(t);
    }
    if (said.error) addError(said.error);
    if (said.sound) addSound(said.sound);
    if (said.picture) {
      run.film = run.film || { t: [], rows: [], jpegs: [] };
      run.film.t.push(said.picture[0]); run.film.rows.push([said.picture[0]]); run.film.jpegs.push(said.picture[1]);
    }
    if (!stale) { stale = true; setTimeout(() => { stale = false; refresh(); }, 100); }
  };
}
function addError({ of, ...values }) {
  run.scores = run.scores || {};
  const { error } = run.scores[of] = run.scores[of] || { error: { t: [], cm: [], missed: [], false: [] } };
  for (const key in values) error[key].push(values[key]);
}
let refreshed = 0;
function refresh() {
  $("slider").max = Math.max(0, run.ticks.length - 1);
  if (run.ticks[0] > 1e6) origin = run.ticks[0];
  if (performance.now() - refreshed > 1000) {
    refreshed = performance.now();
    const wide = Math.max(30, view[1] - view[0]);
    shownLanes = lanes(subject(), run.sensors, tracker);
    if (!run.room) { measure(run); drawRoom(); }
    about();
    tell();
    liveBeams();
    if (follow) view = [Math.max(run.ticks[0], end() - wide), Math.max(run.ticks[0] + 10, end())];
    drawCharts();
  }
  if (follow && !stream) show(run.ticks.length - 1);
}
run = data.runs[0];
chooseRun(run);
recall();
if (data.live != null) {
  for (const news of run.sounds || []) addSound(news);
  liveBeams();
  drawCharts();
  sayHeard();
  listen();
}
