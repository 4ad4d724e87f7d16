"""Procedures that paint materials (GLSL 3.30): one a pattern of `avcli.materials`, and only those that a scene uses.

Every pattern is a function of the place on the surface in metres, so that it has its true size, and fades to its mean
where a pixel is wider than its grain, so that nothing aliases.
"""

from collections.abc import Iterable

LATTICE = 96
"""Cells along each side of the noise that repeats."""

# The noise is looked up: on a processor, calls to a texture are compiled once, and arithmetic wherever it stands.
_COMMON = """
uniform sampler3D lattice;
struct Look { vec3 ground, second; vec2 size; float contrast, gloss, seed; };

float value(vec3 p) {
    vec3 f = fract(p);
    return texture(lattice, (floor(p) + f * f * (3.0 - 2.0 * f) + 0.5) / 96.0).r;
}
float spread(float per_m, float blur) { return 1.0 - smoothstep(0.25, 0.7, per_m * blur); }
float grain(vec3 p, float per_m, float blur) { return (value(p * per_m) - 0.5) * spread(per_m, blur); }
// Noise of four scales, each 2.2 times finer and half as strong: about as natural surfaces have it.
float rough(vec3 p, float per_m, float blur) {
    return grain(p, per_m, blur) + 0.5 * grain(p.yzx + 7.1, 2.2 * per_m, blur)
         + 0.25 * grain(p.zxy + 3.7, 4.9 * per_m, blur) + 0.12 * grain(p + 11.3, 10.7 * per_m, blur);
}
// How much of a pixel a line covers that lies `at` m away.
float line(float at, float width, float blur) {
    float wide = max(blur, 1e-4);
    return clamp((0.5 * (width + wide) - abs(at)) / wide, 0.0, 1.0) * min(1.0, width / wide);
}
// Distance to the nearest of the edges of cells of this length.
float edge(float x, float length) { return (0.5 - abs(fract(x / length) - 0.5)) * length; }
vec3 dyed(vec3 colour, float amount) { return colour * max(1.0 + amount, 0.05); }
float wood_grain(vec2 q, float seed, float blur) {
    float warp = 2.0 * value(vec3(q * vec2(1.5, 5.0), seed));
    float ring = value(vec3(q.x * 1.8, q.y * 38.0 + warp, seed)) - 0.5;
    float fine = value(vec3(q.x * 9.0, q.y * 240.0, seed + 3.0)) - 0.5;
    return ring * spread(38.0, blur) + 0.5 * fine * spread(240.0, blur);
}
"""

# Each is the body of vec3 paint_NAME(Look l, vec3 p, vec2 q, vec2 half_size, vec3 d, float blur,
#                                    inout vec2 bump, inout float gloss, inout vec3 glow)
# p: the place, q: on the surface (m), half_size of a box's face (0: a wall), d: of the ray; bump: slope of the surface.
_PATTERNS = {
    "plaster": """
    float fine = grain(p, 90.0, blur), large = rough(p, 1.3, blur);
    bump += 0.25 * l.contrast * vec2(fine, grain(p.zxy + 5.0, 90.0, blur));
    vec3 c = dyed(l.ground, l.contrast * (0.26 * large + 0.20 * fine));
    float dirt = rough(vec3(q, l.seed), 0.7, blur) + 0.25 * rough(p, 5.0, blur);
    return mix(c, l.second, 0.6 * l.contrast * smoothstep(-0.1, 0.7, dirt));""",
    "wallpaper": """
    vec2 at = q / l.size * 6.2832;
    float motif = sin(at.x) * sin(at.y) + 0.5 * sin(2.0 * at.x + at.y) * sin(at.y);
    float keep = spread(1.5 / l.size.x, blur);
    vec3 c = mix(l.ground, l.second, l.contrast * keep * smoothstep(-0.1, 0.25, motif));
    return dyed(c, 0.06 * rough(p, 2.0, blur) + 0.05 * grain(p, 300.0, blur));""",
    "carpet": """
    float each = 1.0 / l.size.x;
    float fibre = grain(p, each, blur) + 0.6 * grain(p.yxz + 9.0, 0.37 * each, blur);
    float trodden = rough(p, 0.9, blur), tuft = grain(p, 45.0, blur);
    bump += 0.5 * l.contrast * vec2(fibre, grain(p.zxy, each, blur));
    vec3 c = mix(l.ground, l.second, clamp(0.5 + 1.6 * l.contrast * fibre, 0.0, 1.0));
    return dyed(c, l.contrast * (0.45 * trodden + 0.25 * tuft));""",
    "carpet_tile": """
    vec2 cell = floor(q / l.size);
    bool turned = mod(cell.x + cell.y, 2.0) > 0.5;
    vec2 along = turned ? q.yx : q;
    float loop = value(vec3(along * vec2(60.0, 420.0), l.seed)) - 0.5;
    float stripe = value(vec3(along.y * 35.0, cell)) - 0.5;
    float tone = 0.10 * (hash(vec3(cell, 2.0)) - 0.5) + (turned ? 0.05 : -0.05);
    float seam = line(edge(q.x, l.size.x), 0.002, blur) + line(edge(q.y, l.size.y), 0.002, blur);
    float weave = loop * spread(420.0, blur) + 0.5 * stripe * spread(35.0, blur) + grain(p, 150.0, blur);
    vec3 c = mix(l.ground, l.second, clamp(0.5 + 1.4 * l.contrast * weave, 0.0, 1.0));
    return dyed(c, tone + 0.3 * l.contrast * rough(p, 0.8, blur) - 0.25 * min(seam, 1.0));""",
    "tiles": """
    vec2 cell = floor(q / l.size), from = vec2(edge(q.x, l.size.x), edge(q.y, l.size.y));
    float width = clamp(0.012 * l.size.x, 0.002, 0.006);
    float seam = clamp(line(from.x, width, blur) + line(from.y, width, blur), 0.0, 1.0);
    float own = hash(vec3(cell, l.seed + 2.0));
    float cloud = rough(vec3(q, 10.0 * own), 4.0, blur), speck = grain(p, 260.0, blur);
    bump += 0.02 * (vec2(hash(vec3(cell, 5.0)), hash(vec3(cell, 6.0))) - 0.5);
    gloss *= 1.0 - seam;
    vec3 c = dyed(l.ground, 0.9 * l.contrast * (own - 0.5) + l.contrast * (0.8 * cloud + 0.7 * speck));
    return mix(c, dyed(l.second, 0.5 * rough(p, 3.0, blur)), seam);""",
    "planks": """
    float row = floor(q.y / l.size.y), shift = q.x + l.size.x * hash(vec3(row, 3.0, l.seed));
    float board = floor(shift / l.size.x), drawn = hash(vec3(row, board, l.seed + 1.0));
    float own = 0.5 + spread(1.0 / l.size.y, blur) * (drawn - 0.5);
    float seam = line(edge(q.y, l.size.y), 0.0015, blur) + line(edge(shift, l.size.x), 0.0015, blur);
    float figure = wood_grain(vec2(shift, q.y) + 7.0 * drawn, 40.0 * drawn, blur);
    gloss *= 1.0 - 0.35 * (0.5 + rough(p, 1.0, blur));
    vec3 c = mix(l.ground, l.second, clamp(0.45 + l.contrast * (0.9 * (own - 0.5) + 1.5 * figure), 0.0, 1.0));
    return dyed(c, 0.12 * rough(p, 0.7, blur) - 0.45 * min(seam, 1.0));""",
    "herringbone": """
    float ratio = max(2.0, floor(l.size.x / l.size.y + 0.5));
    vec2 at = mat2(0.70711, -0.70711, 0.70711, 0.70711) * q / l.size.y, cell = floor(at);
    float k = mod(cell.x - cell.y, 2.0 * ratio);
    bool lies = k < ratio;
    float step_back = lies ? k : 2.0 * ratio - 1.0 - k;
    vec2 first = lies ? vec2(cell.x - step_back, cell.y) : vec2(cell.x, cell.y - step_back);
    vec2 own_q = lies ? at - first : (at - first).yx;
    float own = 0.5 + spread(1.0 / l.size.y, blur) * (hash(vec3(first, l.seed)) - 0.5);
    float seam = line((0.5 - abs(own_q.y - 0.5)) * l.size.y, 0.0012, blur)
               + line(min(own_q.x, ratio - own_q.x) * l.size.y, 0.0012, blur);
    float figure = wood_grain(own_q * l.size.y + 5.0 * first, 30.0, blur);
    float tone = (lies ? 0.12 : -0.12) + 0.8 * (own - 0.5);
    gloss *= 1.0 - 0.35 * (0.5 + rough(p, 1.0, blur));
    vec3 c = mix(l.ground, l.second, clamp(0.45 + l.contrast * (tone + 1.4 * figure), 0.0, 1.0));
    return dyed(c, 0.10 * rough(p, 0.8, blur) - 0.45 * min(seam, 1.0));""",
    "brick": """
    float row = floor(q.y / l.size.y), x = q.x + 0.5 * l.size.x * mod(row, 2.0);
    vec2 cell = vec2(floor(x / l.size.x), row);
    float uneven = 0.003 * (value(vec3(q * 40.0, 1.0)) - 0.5);
    vec2 from = vec2(edge(x, l.size.x), edge(q.y, l.size.y)) + uneven;
    float mortar = clamp(line(from.x, 0.010, blur + 0.002) + line(from.y, 0.010, blur + 0.002), 0.0, 1.0);
    float keep = spread(1.0 / l.size.y, blur), own = 0.5 + keep * (hash(vec3(cell, l.seed)) - 0.5);
    float burnt = keep * smoothstep(0.85, 1.0, hash(vec3(cell, l.seed + 4.0)));
    bump += 0.5 * l.contrast * vec2(grain(p, 120.0, blur), grain(p.yzx, 120.0, blur));
    float tone = 0.7 * (own - 0.5) - 0.35 * burnt + 0.7 * rough(p, 14.0, blur) + 0.5 * grain(p, 200.0, blur);
    vec3 c = dyed(l.ground, l.contrast * tone) * (1.0 + 0.2 * l.contrast * vec3(own - 0.5, 0.0, 0.5 - own));
    return mix(c, dyed(l.second, 0.3 * rough(p, 6.0, blur)), mortar * (0.3 + l.contrast));""",
    "concrete": """
    float large = rough(p, 0.9, blur), fine = grain(p, 120.0, blur);
    float pore = smoothstep(0.34, 0.44, grain(p.zxy, 55.0, blur));
    float stain = smoothstep(0.1, 0.5, rough(p + 31.0, 0.5, blur));
    float seam = line(edge(q.x, l.size.x), 0.004, blur) + line(edge(q.y, l.size.y), 0.004, blur);
    float from_crack = 0.35 * (value(vec3(q * 1.1, 4.0)) - 0.5) + 0.02 * rough(p, 9.0, blur);
    float crack = spread(3.0, blur) * line(from_crack, 0.002, blur);
    bump += 0.4 * l.contrast * vec2(fine, grain(p.yzx, 120.0, blur));
    gloss *= 1.0 - 0.6 * stain;
    float tone = 0.45 * large + 0.3 * fine - 0.5 * pore - 0.25 * min(seam, 1.0) - 0.3 * crack;
    return mix(dyed(l.ground, l.contrast * tone), l.second, 0.5 * l.contrast * stain);""",
    "terrazzo": """
    float each = 0.6 / l.size.x;
    float dark = value(p * each) - 0.5, light = value(p.yzx * 0.8 * each + 9.0) - 0.5, keep = spread(each, blur);
    vec3 c = mix(l.ground, l.second, l.contrast * mix(0.22, smoothstep(0.12, 0.17, dark), keep));
    c = mix(c, vec3(0.9), l.contrast * mix(0.08, smoothstep(0.17, 0.22, light), keep) * 0.6);
    return dyed(c, 0.10 * rough(p, 1.1, blur) + 0.08 * grain(p, 300.0, blur));""",
    "marble": """
    vec2 cell = floor(q / l.size);
    vec3 at = vec3(q, 13.0 * hash(vec3(cell, l.seed)));
    float swirl = rough(at, 2.2, blur);
    float vein = 1.0 - smoothstep(0.0, 0.09, abs(sin(3.1 * (at.x + 0.6 * at.y) + 6.0 * swirl + 2.0 * at.z)));
    float seam = line(edge(q.x, l.size.x), 0.002, blur) + line(edge(q.y, l.size.y), 0.002, blur);
    gloss *= 1.0 - min(seam, 1.0);
    vec3 c = mix(l.ground, l.second, l.contrast * vein * (0.4 + smoothstep(-0.2, 0.5, swirl)));
    return dyed(c, 0.25 * l.contrast * swirl - 0.3 * min(seam, 1.0));""",
    "curtain": """
    float phase = 6.2832 * q.x / l.size.x + 1.3 * sin(5.1 * q.x + l.seed) + 0.8 * sin(11.0 * q.x);
    phase += 0.35 * sin(1.7 * q.y + 3.0 * q.x);
    bump.x += 2.2 * l.contrast * cos(phase) * spread(1.0 / l.size.x, blur);
    float thread = value(vec3(q.x * 260.0, q.y * 90.0, 0.0)) - 0.5;
    float deep = 1.0 + l.contrast * sin(phase) * spread(1.0 / l.size.x, blur);
    return dyed(mix(l.second, l.ground, clamp(deep, 0.0, 1.0)), deep - 1.0 + 0.16 * thread * spread(260.0, blur));""",
    "blinds": """
    float at = fract(q.x / l.size.x), keep = spread(1.0 / l.size.x, blur);
    bump.x += 0.5 * (at - 0.5) * keep;
    float slit = line(edge(q.x, l.size.x), 0.10 * l.size.x, blur);
    float own = hash(vec3(floor(q.x / l.size.x), 1.0, l.seed)) - 0.5;
    vec3 c = dyed(l.ground, l.contrast * (0.5 * (at - 0.5) + 0.2 * own) * keep);
    return mix(c, l.second, mix(0.10, slit, keep));""",
    "slats": """
    float at = fract(q.x / l.size.x), row = floor(q.x / l.size.x), keep = spread(1.0 / l.size.x, blur);
    float own = hash(vec3(row, 2.0, l.seed)) - 0.5;
    bump.x += 0.5 * keep * (smoothstep(0.75, 0.95, at) - 1.0 + smoothstep(0.05, 0.25, at));
    float gap = mix(0.15, line(edge(q.x, l.size.x), 0.15 * l.size.x, blur), keep);
    vec3 c = dyed(l.ground, l.contrast * (0.6 * keep * own + wood_grain(q.yx, 20.0 * own, blur)));
    return mix(c, l.second, gap);""",
    "studs": """
    vec2 at = fract(q / l.size) - 0.5;
    float r = length(at), keep = spread(1.0 / l.size.x, blur);
    float rim = smoothstep(0.22, 0.30, r) - smoothstep(0.30, 0.38, r);
    bump -= 1.2 * keep * rim * at / max(r, 1e-3);
    float worn = 0.35 * rough(p, 0.9, blur) + 0.2 * grain(p, 160.0, blur);
    return dyed(mix(l.ground, l.second, 0.5 * keep * rim), worn);""",
    "glass": """
    float frame = line(edge(q.x, l.size.x), 0.05, blur) + line(edge(q.y, l.size.y), 0.05, blur);
    gloss *= 1.0 - min(frame, 1.0);
    vec3 c = dyed(l.ground, 0.5 * (value(vec3(q * 0.8, 2.0)) - 0.5) + l.contrast * (value(vec3(q * 2.5, 5.0)) - 0.5));
    return mix(0.45 * c, l.second, min(frame, 1.0));""",
    "daylight": """
    // What is outside: sky, a row of trees and houses at the horizon, and the ground.
    float azimuth = atan(d.y, d.x), height = d.z;
    float trees = 0.10 + 0.16 * value(vec3(azimuth * 6.0, 1.0, 1.0)) + 0.05 * value(vec3(azimuth * 40.0, 2.0, 1.0));
    float cloud = value(vec3(d.xy / max(height, 0.05) * 0.8, 3.0));
    vec3 above = mix(vec3(0.75, 0.88, 1.05), vec3(1.15), 0.4 + 0.6 * cloud);
    vec3 green = l.second * (0.6 + 0.9 * value(d * 60.0));
    vec3 ground = mix(vec3(0.75), 2.0 * l.second, value(vec3(d.xy / min(height, -0.02) * 0.6, 7.0)));
    vec3 seen = height > trees ? above : height > -0.02 ? green : ground;
    glow += 11.0 * outside * l.ground * seen;
    gloss *= 0.5;
    return vec3(0.02);""",
    "door": """
    vec2 from = half_size - abs(q);
    float near = min(from.x, from.y), groove = line(near - 0.12, 0.012, blur) * step(0.5, half_size.y);
    float figure = wood_grain(q.yx, l.seed + 3.0, blur);
    vec3 c = mix(l.ground, l.second, clamp(0.35 + l.contrast * 1.6 * figure, 0.0, 1.0));
    return dyed(c, 0.10 * rough(p, 1.5, blur) - 0.3 * groove - 0.3 * line(near, 0.01, blur));""",
    "weave": """
    vec2 at = q / l.size.x * 6.2832;
    float keep = spread(1.0 / l.size.x, blur), cloth = sin(at.x) * sin(at.y) * keep;
    float seam = line(edge(q.x, l.size.y), 0.006, blur) * step(0.3, l.size.y);
    bump += 0.4 * keep * vec2(cos(at.x), cos(at.y)) * l.contrast;
    vec3 c = mix(l.ground, l.second, clamp(0.5 + 0.5 * cloth + grain(p, 160.0, blur), 0.0, 1.0));
    return dyed(c, l.contrast * (0.5 * rough(p, 3.0, blur) + 0.4 * grain(p, 60.0, blur)) - 0.3 * seam);""",
    "acoustic_tile": """
    vec2 from = vec2(edge(q.x, l.size.x), edge(q.y, l.size.y)), cell = floor(q / l.size);
    float bar = clamp(line(from.x, 0.024, blur) + line(from.y, 0.024, blur), 0.0, 1.0);
    float shade_line = clamp(line(min(from.x, from.y) - 0.014, 0.005, blur), 0.0, 1.0);
    float hole = smoothstep(0.16, 0.3, grain(vec3(q * vec2(1.0, 2.2), hash(vec3(cell, 1.0))), 75.0, blur));
    hole += smoothstep(0.25, 0.4, grain(p, 210.0, blur));
    vec3 c = dyed(l.ground, 0.07 * (hash(vec3(cell, 4.0)) - 0.5) + 0.10 * rough(p, 1.0, blur));
    c = mix(c, l.second, l.contrast * min(hole, 1.0) + 0.5 * shade_line * (1.0 - bar));
    return mix(c, l.ground * 1.05, bar);""",
    "perforated": """
    vec2 at = fract(q / l.size.x) - 0.5;
    float keep = spread(1.0 / l.size.x, blur), hole = mix(0.16, 1.0 - smoothstep(0.19, 0.27, length(at)), keep);
    float seam = line(edge(q.x, l.size.y), 0.002, blur) + line(edge(q.y, l.size.y), 0.002, blur);
    return mix(dyed(l.ground, 0.05 * rough(p, 1.0, blur)), l.second, 0.8 * hole) * (1.0 - 0.2 * min(seam, 1.0));""",
    "brushed": """
    float brush = value(vec3(q.x / l.size.x, q.y / l.size.y, l.seed)) - 0.5;
    float streak = value(vec3(q.x * 3.0, q.y * 90.0, l.seed)) - 0.5;
    float tone = brush * spread(1.0 / l.size.y, blur) + 0.5 * streak * spread(90.0, blur);
    bump.y += 0.1 * tone;
    return dyed(mix(l.ground, l.second, 0.5), l.contrast * (0.6 * tone + 0.5 * rough(p, 2.0, blur)));""",
    "leather": """
    float each = 1.0 / l.size.x, crease = rough(p, each, blur), worn = rough(p, 3.0, blur);
    bump += 0.6 * vec2(crease, rough(p.zxy, each, blur));
    return mix(l.ground, l.second, clamp(0.5 + l.contrast * (crease + 1.2 * worn), 0.0, 1.0));""",
    "paper": """
    vec2 margin = half_size - abs(q);
    float inside = step(0.02, min(margin.x, margin.y));
    float row = floor(q.x / 0.007), at = fract(q.x / 0.007);
    float word = smoothstep(0.42, 0.46, value(vec3(q.y * 130.0, row, l.seed))) * step(0.25, at) * step(at, 0.7);
    word *= step(-0.6, sin(row * 1.7 + l.seed)) * step(q.y, half_size.y * (0.4 + 0.6 * hash(vec3(row, 1.0, l.seed))));
    float keep = spread(140.0, blur);
    return mix(dyed(l.ground, 0.05 * rough(p, 8.0, blur)), l.second, l.contrast * inside * mix(0.10, word, keep));""",
    "whiteboard": """
    vec2 u = half_size.x > 0.0 ? q / half_size : vec2(0.0);
    float row = floor(q.y / 0.11), at = fract(q.y / 0.11) - 0.5;
    float reach = 0.9 * hash(vec3(row, 2.0, l.seed)) - 0.3;
    float hand = 0.28 * sin(95.0 * q.x + 3.0 * value(vec3(q.x * 30.0, row, 1.0))) + 0.2 * sin(213.0 * q.x + row);
    float gap = step(0.35, value(vec3(q.x * 14.0, row, l.seed)));
    float here = step(abs(u.y), 0.85) * step(-0.85, u.x) * step(u.x, reach) * gap;
    float writing = line((at - hand * 0.6) * 0.11, 0.007, blur) * here;
    vec2 box = abs(q - half_size * vec2(0.62, 0.2)) - half_size * vec2(0.2, 0.4);
    float drawn = line(max(box.x, box.y), 0.005, blur);
    vec3 ink = hash(vec3(row, 7.0, l.seed)) > 0.7 ? vec3(0.5, 0.03, 0.03) : l.second;
    vec3 c = dyed(l.ground, -0.10 * smoothstep(0.0, 0.4, rough(p, 1.5, blur)));
    return mix(c, ink, l.contrast * clamp(max(writing, drawn), 0.0, 1.0));""",
    "screen": """
    vec2 u = half_size.x > 0.0 ? q / half_size : q;
    float bezel = step(0.965, max(abs(u.x), abs(u.y)));
    float sharp = spread(25.0 / max(half_size.y, 0.05), blur);
    vec3 c = l.ground * (0.6 + 0.4 * u.y);
    for (int k = 0; k < 3; ++k) {
        float h = l.seed + 5.0 * float(k);
        vec2 middle = 0.9 * vec2(hash(vec3(h, 1.0, 2.0)), hash(vec3(h, 3.0, 4.0))) - 0.45;
        vec2 reach = 0.25 + 0.4 * vec2(hash(vec3(h, 5.0, 6.0)), hash(vec3(h, 7.0, 8.0))), at = u - middle;
        if (abs(at.x) < reach.x && abs(at.y) < reach.y) {
            float row = floor(at.y * 22.0);
            float text = step(0.45, value(vec3(at.x * 45.0, row, h))) * step(0.35, fract(at.y * 22.0));
            text *= step(at.x, reach.x * (1.6 * hash(vec3(row, h, 1.0)) - 0.6)) * sharp;
            vec3 paper = hash(vec3(h, 9.0, 1.0)) > 0.35 ? l.second : vec3(0.05, 0.06, 0.08);
            c = mix(paper, l.second - paper + 0.08, 0.8 * text);
            if (at.y > reach.y - 0.07) c = vec3(0.25, 0.30, 0.38);
        }
    }
    glow += 0.85 * l.contrast * c * (1.0 - bezel);
    return vec3(0.02);""",
    "lamp": """
    vec2 from = half_size - abs(q);
    glow += 7.0 * l.ground * (half_size.x > 0.0 ? 0.85 + 0.15 * smoothstep(0.0, 0.08, min(from.x, from.y)) : 1.0);
    return vec3(0.1);""",
    "foliage": """
    float leaf = value(p / l.size.x) - 0.5, small = grain(p.zxy, 2.7 / l.size.x, blur);
    bump += 1.6 * vec2(value(p.yzx / l.size.x) - 0.5, leaf) + 1.2 * vec2(small, -small);
    vec3 c = mix(l.ground, l.second, clamp(0.5 + 2.0 * l.contrast * (leaf + small), 0.0, 1.0));
    return c * smoothstep(-0.45, 0.1, leaf + small);""",
}
PATTERNS = tuple(_PATTERNS)
"""The names of all patterns, in the order of their numbers; materials with another one are plain."""

_ARGUMENTS = (
    "Look l, vec3 p, vec2 q, vec2 half_size, vec3 d, float blur, inout vec2 bump, inout float gloss, inout vec3 glow"
)


def paint(patterns: Iterable[str]) -> str:
    """Return the GLSL of `paint`, which knows these patterns; any other number leaves the ground's colour."""
    used = [name for name in PATTERNS if name in set(patterns)]
    functions = "".join(f"vec3 paint_{name}({_ARGUMENTS}) {{{_PATTERNS[name]}\n}}\n" for name in used)
    names = "l, p, q, half_size, d, blur, bump, gloss, glow"
    calls = "".join(f"    ONLY(pattern == {PATTERNS.index(name)}) c = paint_{name}({names});\n" for name in used)
    body = f"    vec3 c = l.ground;\n{calls}    return c;\n"
    return f"{_COMMON}{functions}vec3 paint(int pattern, {_ARGUMENTS}) {{\n{body}}}\n"
