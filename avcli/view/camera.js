// Projects points of the room into the picture by the samples of the exact lens that `lens_table` made.

function project(camera, [x, y, z]) {
  const [a, b, c] = camera.T_camera_room.map(row => row[0] * x + row[1] * y + row[2] * z + row[3]);
  const { step, scale, centre, along, across } = camera.lens;
  const across_axis = Math.hypot(a, b), place = Math.atan2(across_axis, c) / step, phi = Math.atan2(b, a);
  const i = Math.min(Math.floor(place), along[0].length - 2), f = place - i;
  if (!(f <= 1)) return null;
  const turn = ((phi / (2 * Math.PI) + 1) % 1) * along.length, j = Math.floor(turn) % along.length, g = turn - Math.floor(turn);
  const sample = table => {
    const between = row => row[i] === null || row[i + 1] === null ? NaN : row[i] + f * (row[i + 1] - row[i]);
    const first = between(table[j]);
    return table.length === 1 ? first : first + g * (between(table[(j + 1) % table.length]) - first);
  };
  const r = sample(along), s = sample(across), cos = across_axis ? a / across_axis : 1, sin = across_axis ? b / across_axis : 0;
  if (Number.isNaN(r)) return null;
  return [centre[0] + scale[0] * (r * cos - s * sin), centre[1] + scale[1] * (r * sin + s * cos)];
}

// Points on the ellipse on the floor that holds the person with 95 %.
function ellipse([x, y], [xx, xy, yy], count = 24) {
  const mean = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy), turn = Math.atan2(2 * xy, xx - yy) / 2;
  const long = 2.448 * Math.sqrt(mean + spread), short = 2.448 * Math.sqrt(Math.max(0, mean - spread));
  return Array.from({ length: count }, (_, k) => {
    const p = long * Math.cos(2 * Math.PI * k / count), q = short * Math.sin(2 * Math.PI * k / count);
    return [x + p * Math.cos(turn) - q * Math.sin(turn), y + p * Math.sin(turn) + q * Math.cos(turn)];
  });
}
