// Charts over time on canvases that share one window of time, and one chart of scores.

const LEFT = () => innerWidth < 620 ? 118 : 140, RIGHT = 12;

function canvas(id, height) {
  const node = $(id), ratio = devicePixelRatio || 1, width = node.parentElement.clientWidth;
  node.style.height = height + "px";
  node.width = Math.max(1, Math.round(width * ratio));
  node.height = Math.round(height * ratio);
  const pen = node.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "12px system-ui, sans-serif";
  pen.textBaseline = "middle";
  const left = LEFT();
  node.at = { left, width, right: RIGHT, x: t => left + (t - view[0]) / (view[1] - view[0] || 1) * (width - left - RIGHT) };
  return { pen, width, height, left, x: node.at.x };
}
function timeAt(node, clientX) {
  const box = node.getBoundingClientRect(), { left, width, right } = node.at;
  return view[0] + Math.min(1, Math.max(0, (clientX - box.left - left) / (width - left - right))) * (view[1] - view[0]);
}
function ticks(low, high, most) {
  const span = high - low || 1;
  let step = 10 ** Math.floor(Math.log10(span / most));
  step = [1, 2, 5, 10].map(k => k * step).find(s => span / s <= most);
  if (span > 100) step = [10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400].find(s => span / s <= most) || step;
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(0, Math.floor(high / step + 1e-9) - first + 1) }, (_, k) => (first + k) * step);
}
function clock(t, digits = 2) {
  t = Math.max(0, t - origin);
  if (end() - origin < 100) return t.toFixed(digits) + " s";
  const whole = Math.floor(t + 1e-6), two = n => String(n).padStart(2, "0");
  const rest = digits ? (t - whole).toFixed(digits).slice(1) : "";
  return (whole >= 3600 ? Math.floor(whole / 3600) + ":" + two(Math.floor(whole / 60) % 60) : Math.floor(whole / 60)) + ":" + two(whole % 60) + rest;
}
function timeAxis({ pen, width, left, x }, y) {
  pen.fillStyle = ink("--soft");
  pen.textAlign = "center";
  for (const t of ticks(view[0] - origin, view[1] - origin, (width - left) / 64)) {
    const digits = view[1] - view[0] < 2 ? 2 : view[1] - view[0] < 20 ? 1 : 0;
    pen.fillText(clock(t + origin, digits), Math.min(width - 22, Math.max(left + 16, x(t + origin))), y);
  }
}

function drawLanes() {
  const ROW = 17, seen = shownLanes.filter(lane => lane.spans.some(([a, b]) => b > view[0] && a < view[1]) || lane.kind !== "false");
  const here = new Set(seen.filter(lane => lane.spans.some(([a, b]) => b > view[0] && a < view[1])).map(lane => lane.who));
  const people = [...here].slice(0, 40), rows = seen.filter(lane => people.includes(lane.who));
  $("more").textContent = here.size > people.length ? `${here.size - people.length} more are not shown; zoom in to see them.` : "";
  const area = canvas("timeline", Math.max(1, rows.length) * ROW + 26), { pen, width, left, x } = area;
  rows.forEach((lane, i) => {
    const y = i * ROW;
    if (!i || rows[i - 1].who !== lane.who) {
      if (i) { pen.fillStyle = ink("--faint"); pen.fillRect(0, y, width, 1); }
      pen.fillStyle = ink("--ink");
      pen.textAlign = "left";
      pen.fillText(lane.kind === "false" ? lane.who : `${subject().kind === "truth" ? "person" : "track"} ${lane.who}`, 0, y + ROW / 2 + 1, left * 0.52);
    }
    pen.fillStyle = ink("--soft");
    pen.textAlign = "right";
    pen.fillText(lane.what, left - 8, y + ROW / 2 + 1, left * 0.48);
    for (const [a, b, k] of lane.spans) {
      if (b < view[0] || a > view[1]) continue;
      const from = Math.max(left, x(a)), to = Math.min(width - RIGHT, x(b)), thin = k < 0 || lane.kind === "false";
      pen.fillStyle = lane.kind === "voice" ? ink("--voice") : lane.kind === "track" || lane.kind === "false" ? hue(Math.max(0, k)) : ink(lane.kind === "microphones" ? "--heard" : "--soft");
      pen.fillRect(from, y + (thin ? 7 : 3), Math.max(1, to - from), thin ? 4 : ROW - 6);
    }
  });
  timeAxis(area, area.height - 9);
  $("timeline").setAttribute("aria-label", `Lanes of ${here.size} people from ${clock(view[0])} to ${clock(view[1])}; the list below says the same in words`);
}

const spectrograms = new Map();
const bytesOf = sound => sound.bytes || (sound.bytes = Uint8Array.from(atob(sound.peak), c => c.charCodeAt(0)));
function drawSound() {
  const sound = heard && !heard.live ? heard : run.sound;  // of a live run the microphone is drawn
  $("sound-chart").hidden = !sound;
  if (!sound) return;
  const { pen, width, height, left, x } = canvas("sound", 150), waves = 54;
  const peak = bytesOf(sound);
  $("sound-title").textContent = `Sound of ${sound.name}`;
  pen.fillStyle = ink("--soft");
  pen.textAlign = "right";
  pen.fillText("waveform, dB", left - 8, waves / 2, left - 8);
  const per = (view[1] - view[0]) / Math.max(1, width - left - RIGHT);
  pen.fillStyle = ink("--accent");
  for (let px = left; px < width - RIGHT; px++) {
    const t = view[0] + (px - left) * per, from = Math.floor((t - sound.start) / sound.step), to = Math.max(from + 1, Math.floor((t + per - sound.start) / sound.step));
    let most = 0;
    for (let k = Math.max(0, from); k < Math.min(peak.length, to); k++) most = Math.max(most, peak[k]);
    const tall = most / 255 * (waves - 6);
    pen.fillRect(px, waves / 2 - tall / 2, 1, Math.max(tall, most ? 1 : 0));
  }
  if (!sound.live && !spectrograms.has(sound)) {
    const image = new Image();
    image.onload = () => { spectrograms.set(sound, coloured(image)); drawSound(); };
    image.src = sound.spectrogram;
    spectrograms.set(sound, null);
  }
  const live = sound.live ? liveSpectrogram(sound) : null, first = live ? live.start : sound.start;
  const picture = sound.live ? live && live.picture : spectrograms.get(sound), top = waves + 4, tall = height - top - 4;
  if (picture) {
    const a = (view[0] - first) / sound.step, b = (view[1] - first) / sound.step, from = Math.max(0, a), to = Math.min(picture.width, b);
    pen.imageSmoothingEnabled = b - a < 4 * width;
    if (to > from) pen.drawImage(picture, from, 0, to - from, picture.height, x(first + from * sound.step), top, (to - from) * sound.step / per, tall);
  }
  pen.fillStyle = ink("--soft");
  const place = hz => top + tall * (1 - Math.log(hz / sound.low_hz) / Math.log(sound.high_hz / sound.low_hz));
  for (const hz of [100, 300, 1000, 3000]) if (hz < sound.high_hz) pen.fillText(hz < 1000 ? `${hz} Hz` : `${hz / 1000} kHz`, left - 8, place(hz));
}
function coloured(image) {
  const sheet = document.createElement("canvas");
  sheet.width = image.width;
  sheet.height = image.height;
  const pen = sheet.getContext("2d");
  pen.drawImage(image, 0, 0);
  const pixels = pen.getImageData(0, 0, sheet.width, sheet.height), v = pixels.data;
  for (let i = 0; i < v.length; i += 4) {  // dark blue over orange to white, ever brighter
    const k = v[i] / 255;
    v[i] = 255 * Math.min(1, 0.05 + 1.6 * k * k + 0.2 * k);
    v[i + 1] = 255 * Math.min(1, 0.05 + 0.25 * k + 0.75 * k ** 3);
    v[i + 2] = 255 * Math.min(1, 0.18 + 0.55 * k * (1 - k) * 2 + 0.7 * k ** 6);
  }
  pen.putImageData(pixels, 0, 0);
  return sheet;
}

function drawError() {
  const scored = run.scores ? trackers().filter(t => run.scores[t.name]) : [];
  $("error-chart").hidden = !scored.length;
  if (!scored.length) return;
  const { pen, width, height, left, x } = canvas("error", 220), strip = 56, bottom = 22, tall = height - strip - bottom;
  const shown = scored.filter(t => compare || t === tracker);
  let most = 0;
  for (const one of shown) { const { t, cm } = run.scores[one.name].error; cm.forEach((v, i) => { if (v !== null && t[i] >= view[0] && t[i] <= view[1]) most = Math.max(most, v); }); }
  const marks = ticks(0, most || 1, 4), top = Math.max(most, marks[marks.length - 1]) * 1.08 || 1, y = v => 8 + (tall - 8) * (1 - v / top);
  pen.textAlign = "right";
  for (const v of marks) {
    pen.fillStyle = ink("--line");
    pen.fillRect(left, y(v), width - left - RIGHT, 1);
    pen.fillStyle = ink("--soft");
    pen.fillText(`${+v.toFixed(2)} cm`, left - 8, y(v));
  }
  pen.save();
  pen.beginPath();
  pen.rect(left, 0, width - left - RIGHT, height);
  pen.clip();
  for (const one of shown) {
    const { t, cm } = run.scores[one.name].error, gap = 1.6 * one.step, look = trackerLook(one);
    pen.strokeStyle = look.color;
    pen.lineWidth = one === tracker ? 2.2 : 1.4;
    pen.setLineDash(one === tracker ? [] : look.dash);
    pen.beginPath();
    let last = -Infinity;
    for (let i = 0; i < t.length; i++) {
      if (cm[i] === null || t[i] < view[0] - gap || t[i] > view[1] + gap) continue;
      if (t[i] - last > gap) { pen.moveTo(x(t[i]), y(cm[i])); pen.lineTo(x(t[i]) + 1, y(cm[i])); } else pen.lineTo(x(t[i]), y(cm[i]));
      last = t[i];
    }
    pen.stroke();
  }
  pen.restore();
  const score = run.scores[tracker.name];
  if (score) {
    const middle = height - bottom - 20, largest = Math.max(1, ...score.error.missed, ...score.error.false), unit = 17 / largest;
    pen.fillStyle = ink("--soft");
    pen.textAlign = "right";
    pen.fillText("missed", left - 8, middle - 9);
    pen.fillText("false", left - 8, middle + 9);
    pen.fillStyle = ink("--line");
    pen.fillRect(left, middle, width - left - RIGHT, 1);
    score.error.t.forEach((t, i) => {
      if (t < view[0] || t > view[1]) return;
      const from = Math.max(left, x(t - tracker.step / 2)), wide = Math.max(1, Math.min(width - RIGHT, x(t + tracker.step / 2)) - from);
      pen.fillStyle = ink("--loss");
      pen.fillRect(from, middle - unit * score.error.missed[i], wide, unit * score.error.missed[i]);
      pen.fillStyle = ink("--voice");
      pen.fillRect(from, middle + 1, wide, unit * score.error.false[i]);
    });
  }
  timeAxis({ pen, width, left, x }, height - 9);
  $("error-legend").replaceChildren(...shown.map(one => key(one.name, { ...trackerLook(one), ...(one === tracker ? { dash: [] } : {}) })), shown.length > 1 && score ? `missed and false: of ${tracker.name}` : "");
}
// The moment of the largest error near a place of the error chart.
function peakNear(node, clientX) {
  const wanted = timeAt(node, clientX), reach = 8 * (view[1] - view[0]) / Math.max(1, node.at.width - node.at.left);
  let best = wanted, most = -1;
  for (const one of trackers().filter(t => run.scores[t.name] && (compare || t === tracker))) {
    const { t, cm } = run.scores[one.name].error;
    t.forEach((time, i) => { if (Math.abs(time - wanted) <= reach && cm[i] !== null && cm[i] > most) { most = cm[i]; best = time; } });
  }
  return best;
}
function key(text, look) {
  const item = document.createElement("span"), mark = document.createElementNS(SVG, "svg");
  mark.setAttribute("viewBox", "0 0 28 8");
  mark.setAttribute("aria-hidden", "true");
  add(mark, "line", { x1: 1, x2: 27, y1: 4, y2: 4, stroke: look.color, "stroke-width": 3, "stroke-dasharray": look.dash.join(" ") });
  item.append(mark, text);
  return item;
}

function drawScores() {
  const score = run.scores && tracker && run.scores[tracker.name];
  $("hota-chart").hidden = !(score && score.hota);
  if (!score || !score.hota) return;
  const svg = $("hota"), names = Object.keys(score.hota), alpha = data.alpha;
  const looks = { HOTA: { color: ink("--ink"), dash: [] }, LocA: { color: hue(2), dash: [] }, DetA: { color: hue(0), dash: [7, 4] }, AssA: { color: hue(1), dash: [1.5, 4] } };
  const all = names.flatMap(name => score.hota[name]).map(v => 100 * v), low = Math.min(...all), floor = low > 90 ? 90 : low > 50 ? 50 : 0;
  const width = svg.clientWidth || 300, height = 210, left = 40;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren();
  const x = a => left + (a - 0) / 1 * (width - left - 8), y = v => 10 + (height - 34) * (1 - (v - floor) / (100 - floor));
  for (const v of [floor, (floor + 100) / 2, 100]) {
    add(svg, "line", { x1: left, x2: width - 8, y1: y(v), y2: y(v), class: "axis" });
    add(svg, "text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, v);
  }
  for (const a of [0, 0.2, 0.4, 0.6, 0.8, 1]) add(svg, "text", { x: x(a), y: height - 6, "text-anchor": "middle" }, a);
  for (const name of names) add(svg, "path", { d: "M" + alpha.map((a, i) => `${x(a).toFixed(1)} ${y(100 * score.hota[name][i]).toFixed(1)}`).join("L"), fill: "none", stroke: looks[name].color, "stroke-width": name === "HOTA" ? 3 : 2, "stroke-dasharray": looks[name].dash.join(" ") });
  $("hota-legend").replaceChildren(...names.map(name => key(name, looks[name])));
  $("hota-note").textContent = floor ? `The scale begins at ${floor} %.` : "";
}
