// Streams of records: what each says at a moment, and as lanes over time.

const ID = 0, X = 1, Y = 2, SPEAKING = 3, EXISTENCE = 4, OBSERVED = 5, COVARIANCE = 6;  // of people
const SCORE = 3, SPREAD = 4, BOX = 7, ORIGIN = 8, DIRECTION = 9;  // of detections, whose x, y, z come first
const NEAR_M = 1, BODY_M = 1.7, MOUTH_M = 1.5, TRAIL_S = 6;

function prepare(stream) {
  stream.rows.sort((a, b) => a[0] - b[0]);
  const steps = stream.rows.slice(1, 400).map((row, i) => row[0] - stream.rows[i][0]).filter(v => v > 1e-6).sort((a, b) => a - b);
  stream.step = steps.length ? steps[steps.length >> 1] : 0.1;
  stream.labels = new Map();
  for (const row of stream.rows) number(stream, row);
}
function number(stream, row) {
  if (stream.kind !== "detections") for (const person of row[1]) if (!stream.labels.has(person[ID])) stream.labels.set(person[ID], stream.labels.size);
}
// The number of the last row at this time, -1 where the stream says nothing then.
function rowAt(rows, t) {
  let low = 0, high = rows.length;
  while (low < high) { const middle = (low + high) >> 1; if (rows[middle][0] <= t + 1e-3) low = middle + 1; else high = middle; }
  return low - 1;
}
function objectsAt(stream, t) {
  const at = rowAt(stream.rows, t);
  return at >= 0 && t - stream.rows[at][0] < 1.5 * stream.step ? stream.rows[at][1] : [];
}
// Where each person of a stream went in the last seconds: identity -> points, the latest first.
function trails(stream, t) {
  const paths = new Map(), last = new Map();
  for (let i = rowAt(stream.rows, t); i >= 0 && stream.rows[i][0] > t - TRAIL_S; i--) {
    const [time, people] = stream.rows[i];
    for (const person of people) {
      if (!last.has(person[ID])) { if (t - time > 1.5 * stream.step) continue; paths.set(person[ID], []); }
      else if (last.get(person[ID]) - time > 1.5 * stream.step) continue;
      last.set(person[ID], time);
      paths.get(person[ID]).push([person[X], person[Y]]);
    }
  }
  return paths;
}

class Spans {
  constructor(step) { this.step = step; this.list = []; }
  add(t, value, step = this.step) {
    const last = this.list[this.list.length - 1];
    if (last && last[2] === value && t - last[1] < 0.7 * step) last[1] = t + step / 2;
    else this.list.push([t - step / 2, t + step / 2, value]);
  }
}
// Whose each item is: one person an item and one item a person, the nearest pairs first, within a metre.
function owners(people, items, first) {
  const pairs = [], whose = new Array(items.length).fill(null), taken = new Set();
  items.forEach((item, i) => {
    if (item[first] == null) return;
    for (const person of people) {
      const distance = Math.hypot(person[X] - item[first], person[Y] - item[first + 1]);
      if (distance < NEAR_M) pairs.push([distance, i, person]);
    }
  });
  for (const [, i, person] of pairs.sort((a, b) => a[0] - b[0])) if (!whose[i] && !taken.has(person)) { whose[i] = person; taken.add(person); }
  return whose;
}
// Lanes of each person of `people`: when somebody spoke, was found by each sensor and, where `tracker` is another
// stream, was tracked; what is within a metre belongs to a person.
function lanes(people, sensors, tracker) {
  const found = new Map();
  const lane = (who, what, kind, step) => {
    if (!found.has(who)) found.set(who, new Map());
    const own = found.get(who);
    if (!own.has(what)) own.set(what, { who, what, kind, spans: new Spans(step) });
    return own.get(what).spans;
  };
  for (const [t, row] of people.rows) for (const person of row) {
    const who = person[ID];
    if (person[SPEAKING] != null) { const spans = lane(who, "speaks", "voice", people.step); if (person[SPEAKING] > 0.5) spans.add(t, 0); }
    for (const sensor of sensors) lane(who, words(sensor), sensor.sensor, sensor.step);
    lane(who, tracker === people ? "tracked" : tracker ? "tracked" : "there", "track", (tracker || people).step);
    if (!tracker || tracker === people) lane(who, tracker ? "tracked" : "there", "track", people.step).add(t, person[OBSERVED] === 0 ? -1 : people.labels.get(who));
  }
  for (const sensor of sensors) for (const [t, row] of sensor.rows) {
    for (const person of owners(objectsAt(people, t), row, 0))
      if (person) lane(person[ID], words(sensor), sensor.sensor, sensor.step).add(t, 0);
  }
  if (tracker && tracker !== people) for (const [t, row] of tracker.rows) {
    const whose = owners(objectsAt(people, t), row, X);
    for (const [i, track] of row.entries()) {
      const person = whose[i];
      if (person) lane(person[ID], "tracked", "track", tracker.step).add(t, tracker.labels.get(track[ID]));
      else lane(`track ${track[ID]}`, "nobody near", "false", tracker.step).add(t, tracker.labels.get(track[ID]));
    }
  }
  return [...found.values()].flatMap(own => [...own.values()].map(one => ({ ...one, spans: one.spans.list })));
}
function words(sensor) {
  const verb = sensor.sensor === "microphones" ? "heard" : "seen";
  return ["audio", "video", "detections"].includes(sensor.name) ? verb : `${verb} by ${sensor.name}`;
}
