// Sound of a live run: its pieces come from the server and play one after another by the clock of the sound card.

const PIECE_S = 0.5, BEHIND_S = 1.5, LARGEST_LAG_S = 5;
let stream = null, ended = false;
const soundEnd = () => run.sound ? run.sound.start + run.sound.peaks.length * run.sound.step : -Infinity;
const streamTime = () => stream.base === null ? stream.next : Math.min(stream.next, stream.context.currentTime - stream.base);

// New columns of waveform and spectrogram, in half decibels below 255 at full scale.
function addSound(news) {
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)), peak = bytes(news.peak), levels = bytes(news.levels);
  if (!run.sound) {
    const { name, start, step, bands, low_hz, high_hz } = news;
    run.sound = { name, start, step, bands, low_hz, high_hz, live: true, peaks: [], levels: [], loudest: 1, brightest: 1, steers: news.beams };
    tune(run.sound);
    controls();
    about();
    $("mute").hidden = $("hear").hidden = false;
  }
  const sound = run.sound;
  for (let k = 0; k < peak.length; k++) {
    const column = levels.subarray(k * sound.bands, (k + 1) * sound.bands);
    sound.peaks.push(peak[k]);
    sound.levels.push(column);
    sound.loudest = Math.max(sound.loudest, peak[k]);
    for (const level of column) sound.brightest = Math.max(sound.brightest, level);
  }
  sound.bytes = Uint8Array.from(sound.peaks, v => Math.max(0, 255 * (1 - (sound.loudest - v) / 120)));
}
// The columns that are in view, as the picture that finished runs have.
function liveSpectrogram(sound) {
  const from = Math.max(0, Math.floor((view[0] - sound.start) / sound.step)), to = Math.min(sound.levels.length, Math.ceil((view[1] - sound.start) / sound.step));
  if (to <= from) return null;
  const sheet = document.createElement("canvas"), wide = to - from;
  sheet.width = wide;
  sheet.height = sound.bands;
  const pen = sheet.getContext("2d"), pixels = pen.createImageData(wide, sound.bands);
  for (let x = 0; x < wide; x++) for (let band = 0; band < sound.bands; band++) {
    const at = 4 * ((sound.bands - 1 - band) * wide + x), level = Math.max(0, 255 * (1 - (sound.brightest - sound.levels[from + x][band]) / 120));
    pixels.data.set([level, level, level, 255], at);
  }
  pen.putImageData(pixels, 0, 0);
  return { picture: coloured(sheet), start: sound.start + from * sound.step };
}
function liveBeams() {
  if (!run.sound || !run.sound.live || !run.sound.steers) return;
  const known = run.beams || [];
  const beams = !tracker ? [] : [...tracker.labels.keys()].map(id => known.find(beam => beam.id === id && beam.tracker === tracker.name) || { id, tracker: tracker.name, name: `the beam at track ${id}`, live: true });
  if (beams.length === known.length) return;
  run.beams = beams;
  $("heard").replaceChildren(...sounds().map((one, i) => new Option(one.name, i)));
  $("heard").value = Math.max(0, sounds().indexOf(heard));
}
function stopStream() { if (stream) stream.context.close(); stream = null; }
async function startStream() {
  const context = new AudioContext(), gain = context.createGain(), own = stream = { context, gain, base: null, loudest: 1e-4, next: follow ? Math.max(run.sound.start, soundEnd() - BEHIND_S) : run.ticks[now] };
  gain.connect(context.destination);
  const pause = ms => new Promise(done => setTimeout(done, ms));
  while (stream === own) {
    if (follow && soundEnd() - streamTime() > LARGEST_LAG_S) { own.next = soundEnd() - BEHIND_S; own.base = null; }
    if (own.next + PIECE_S > soundEnd() || own.base !== null && own.next - streamTime() > 2 * PIECE_S) {
      if (ended && own.next + PIECE_S > soundEnd() && streamTime() >= own.next - 0.02) break;
      await pause(60);
      continue;
    }
    const from = own.next, of = heard && heard.id !== undefined ? `&of=${encodeURIComponent(heard.id)}` : "";
    let samples, rate;
    try {
      const answer = await fetch(`sound?from=${from}&to=${from + PIECE_S}${of}`);
      if (!answer.ok) throw new Error(answer.status);
      rate = +answer.headers.get("X-Rate");
      samples = new Float32Array(await answer.arrayBuffer());
    } catch { if (heard !== run.sound) { listenTo(run.sound); $("hearing").textContent = "There is no beam here now; you hear the microphone."; } await pause(500); continue; }
    if (stream !== own || !samples.length) continue;
    if (context.state === "suspended") context.resume();
    for (const v of samples) own.loudest = Math.max(own.loudest, Math.abs(v));
    gain.gain.value = $("speaker").muted ? 0 : 0.6 / own.loudest;
    const buffer = context.createBuffer(1, samples.length, rate), source = context.createBufferSource();
    buffer.copyToChannel(samples, 0);
    source.buffer = buffer;
    source.connect(gain);
    if (own.base === null || own.base + from < context.currentTime + 0.02) own.base = context.currentTime + 0.1 - from;  // late: all that follows waits
    source.start(own.base + from);
    own.next = from + PIECE_S;
  }
  if (stream === own) stop();
}
