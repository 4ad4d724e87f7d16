"""The renderer's shaders (GLSL 3.30). Everything is in the camera's frame, metres; image row 0 is gl row 0."""

from avcli.lens.shader import GLSL as LENS

RAYS = (
    LENS
    + """
uniform vec3 circle;                    // that the lens lights: its middle and its radius, px; 0: everything
out vec4 ray;
void main() {
    vec2 px = gl_FragCoord.xy - 0.5;
    ray = circle.z > 0.0 && distance(px, circle.xy) > circle.z ? vec4(0.0) : stored_ray(px);
}
"""
)

CONE = """
// Distance along the unit ray d from the origin to a rounded cone, negative where it is missed. (a, ra) and (b, rb) are
// its balls in the space in which it is not flattened: x + bulge.w n (n.(x - middle)), n = bulge.xyz.
float hit_cone(vec3 d, vec4 ball_a, vec4 ball_b, vec4 bulge, vec3 middle) {
    vec3 shift = -bulge.w * dot(bulge.xyz, middle) * bulge.xyz;
    vec3 dir = d + bulge.w * dot(bulge.xyz, d) * bulge.xyz;
    float speed = length(dir);
    dir /= speed;
    // Start where the ray passes the cone's middle: the large numbers cancel before they are squared.
    float start = dot(0.5 * (ball_a.xyz + ball_b.xyz) - shift, dir);
    vec3 p = shift + start * dir - ball_a.xyz;
    vec3 axis = ball_b.xyz - ball_a.xyz;
    float ra = ball_a.w, rb = ball_b.w, taper = ra - rb;
    float aa = dot(axis, axis), ad = dot(axis, dir), ap = dot(axis, p), dp = dot(dir, p), pp = dot(p, p);
    float slant = aa - taper * taper;
    float t = 1e9;
    if (slant > 0.0) {
        float q2 = slant - ad * ad;
        float q1 = slant * dp - ap * ad + ad * taper * ra;
        float q0 = slant * pp - ap * ap + 2.0 * ap * taper * ra - aa * ra * ra;
        float h = q1 * q1 - q2 * q0;
        if (h < 0.0) return -1.0;
        float side = (-sqrt(h) - q1) / q2;
        float along = ap - ra * taper + side * ad;
        if (along > 0.0 && along < slant) return (start + side) / speed;
    }
    float ha = dp * dp - pp + ra * ra;
    if (ha > 0.0) t = -dp - sqrt(ha);
    vec3 e = p - axis;
    float de = dot(dir, e), hb = de * de - dot(e, e) + rb * rb;
    if (hb > 0.0) t = min(t, -de - sqrt(hb));
    return t < 1e8 ? (start + t) / speed : -1.0;
}
"""

TABLE_LINES = 4096  # of a table's texture; every OpenGL 3.3 has textures of 16384 in practice, 1024 by right
TABLE = f"""
// Where a texture holds one part of a row of a table with so many parts a row (see Canvas.table).
ivec2 table_place(int row, int part, int parts) {{
    return ivec2(row / {TABLE_LINES} * parts + part, row % {TABLE_LINES});
}}
"""

CORNER = """#version 330
in vec4 rectangle;   // x0, y0, x1, y1 in pixel edges
uniform vec2 size;
vec4 corner() {
    vec2 at = mix(rectangle.xy, rectangle.zw, vec2(gl_VertexID & 1, gl_VertexID >> 1));
    return vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
}
"""

QUAD = """#version 330
in vec2 origin;      // of a parallelogram of pixels, and its two edges
in vec4 edges;
uniform vec2 size;
vec4 corner() {
    vec2 at = origin + float(gl_VertexID & 1) * edges.xy + float(gl_VertexID >> 1) * edges.zw;
    return vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
}
"""

PEOPLE_VERTEX = (
    QUAD
    + """
in vec4 ball_a, ball_b, bulge, middle;   // middle.w: index of the cone
flat out vec4 fa, fb, fbulge, fmiddle;
void main() { gl_Position = corner(); fa = ball_a; fb = ball_b; fbulge = bulge; fmiddle = middle; }
"""
)

# Which cone is seen, and how far: depth test between cones, comparison with the room by hand.
PEOPLE_FRAGMENT = (
    LENS
    + CONE
    + """
flat in vec4 fa, fb, fbulge, fmiddle;
uniform sampler2D room_depth;
uniform float far;   // m, beyond all that is drawn
out vec2 seen;
void main() {
    vec3 d = ray_of(ivec2(gl_FragCoord.xy));
    if (d == vec3(0.0)) discard;
    float t = hit_cone(d, fa, fb, fbulge, fmiddle.xyz);
    if (t <= 0.0) discard;
    float room = texelFetch(room_depth, ivec2(gl_FragCoord.xy), 0).r;
    if (room > 0.0 && t > room) discard;
    seen = vec2(t, fmiddle.w + 1.0);
    gl_FragDepth = clamp(t / far, 0.0, 1.0);
}
"""
)

# The whole silhouette of each person in a tile of its own: nothing hides it, and the image has no border.
SHAPE_FRAGMENT = (
    LENS
    + CONE
    + """
flat in vec4 fa, fb, fbulge, fmiddle, ftile;
uniform float pitch;
flat in vec2 fplace;   // from tile to image, in image pixels
out float covered;
void main() {
    if (any(lessThan(gl_FragCoord.xy, ftile.xy)) || any(greaterThan(gl_FragCoord.xy, ftile.zw))) discard;
    vec2 px = (gl_FragCoord.xy - 0.5) * pitch + fplace;   // the middle of a pixel, or beyond the lit picture
    ivec2 size = textureSize(rays, 0), at = ivec2(floor(px));
    vec3 d = ray_of(clamp(at, ivec2(0), size - 1));
    bool beyond = any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size)) || d == vec3(0.0);
    for (int turn = 0; turn < int(beyond); ++turn) d = ray_through(px);   // a loop: llvmpipe runs both branches
    if (d == vec3(0.0) || hit_cone(d, fa, fb, fbulge, fmiddle.xyz) <= 0.0) discard;
    covered = 1.0;
}
"""
)

SHAPE_VERTEX = (
    QUAD
    + """
in vec4 ball_a, ball_b, bulge, middle, tile;
in vec2 place;
flat out vec4 fa, fb, fbulge, fmiddle, ftile;
flat out vec2 fplace;
void main() {
    gl_Position = corner();
    fa = ball_a; fb = ball_b; fbulge = bulge; fmiddle = middle; fplace = place; ftile = tile;
}
"""
)

FLAT_VERTEX = (
    CORNER
    + """
uniform float level;   // depth of the quad, against which marked pixels are tested
void main() { gl_Position = vec4(corner().xy, 2.0 * level - 1.0, 1.0); }
"""
)

NOISE = """
float hash(vec3 p) {
    p = fract(p * vec3(0.1031, 0.1030, 0.0973));
    p += dot(p, p.yxz + 33.33);
    return fract((p.x + p.y) * p.z);
}
float noise(vec3 p) {
    vec3 i = floor(p), f = fract(p);
    f = f * f * (3.0 - 2.0 * f);
    vec3 x = vec3(1, 0, 0), y = vec3(0, 1, 0), k = i + vec3(0, 0, 1);
    vec4 low = vec4(hash(i), hash(i + x), hash(i + y), hash(i + x + y));
    vec4 high = vec4(hash(k), hash(k + x), hash(k + y), hash(k + x + y));
    vec4 mid = mix(low, high, f.z);
    return mix(mix(mid.x, mid.y, f.x), mix(mid.z, mid.w, f.x), f.y);
}
// Light from above and, bounced, from below.
float sky(vec3 n) { return 0.40 + 0.18 * n.z; }
// Linear light to the picture: highlights roll off, gamma 2.
vec3 display(vec3 light) { return sqrt(clamp(light * (1.0 + 0.12 * light) / (1.0 + 0.62 * light), 0.0, 1.0)); }
"""

LIGHT = (
    NOISE
    + """
uniform vec3 lamps[2];       // middles of the ceiling lights, room frame
const float LAMP_RADIUS = 0.35;

float lamp(vec3 p, vec3 n, int k) {
    vec3 way = lamps[k] - p;
    float square = dot(way, way);
    return 2.7 * max(dot(n, way) * inversesqrt(square) + 0.08, 0.0) / (square + 1.5);
}
// All light where nothing stands before lamps or sky.
float unblocked(vec3 p, vec3 n) { return sky(n) + lamp(p, n, 0) + lamp(p, n, 1); }
"""
)

SHADOW_VERTEX = (
    CORNER
    + """
in vec2 balls;       // first and end index of the person's balls
flat out ivec2 mine;
void main() { gl_Position = corner(); mine = ivec2(balls + 0.5); }
"""
)

# How much darker a person makes the room around their feet: a factor for the picture, on a coarse grid.
SHADOW_FRAGMENT = (
    LENS
    + LIGHT
    + """
flat in ivec2 mine;
uniform sampler2D seen, surface, balls;
uniform mat3 to_room;
uniform vec3 eye;
uniform int coarse;
out float factor;
void main() {
    ivec2 at = min(ivec2(gl_FragCoord.xy) * coarse + coarse / 2, textureSize(seen, 0) - 1);
    vec2 hit = texelFetch(seen, at, 0).rg;
    if (hit.y < 0.5) discard;
    vec3 p = eye + hit.x * (to_room * ray_of(at)), n = texelFetch(surface, at, 0).xyz;
    float open = 1.0;
    vec2 clear = vec2(1.0);
    vec3 ways[2];
    vec2 spread;
    for (int k = 0; k < 2; ++k) {
        ways[k] = lamps[k] - p;
        float far = length(ways[k]);
        ways[k] /= far;
        spread[k] = LAMP_RADIUS / far;
    }
    for (int j = mine.x; j < mine.y; ++j) {
        vec4 ball = texelFetch(balls, ivec2(j, 0), 0);
        vec3 way = ball.xyz - p;
        float square = max(dot(way, way), ball.w * ball.w), r2 = ball.w * ball.w;
        open *= 1.0 - 0.85 * max(dot(n, way), 0.0) * inversesqrt(square) * r2 / square;
        for (int k = 0; k < 2; ++k) {
            float along = dot(way, ways[k]);
            float aside = sqrt(max(square - along * along, 0.0)), soft = max(along, 0.0) * spread[k] + 0.02;
            float cover = 1.0 - smoothstep(ball.w - soft, ball.w + soft, aside);
            if (along > 0.0) clear[k] *= 1.0 - cover * min(1.0, r2 / (soft * soft));
        }
    }
    vec4 foot = texelFetch(balls, ivec2(mine.x + 3, 0), 0);
    float fade = smoothstep(0.65, 0.4, distance(foot.xy, p.xy));
    float all = unblocked(p, n);
    float left = open * sky(n) + clear.x * lamp(p, n, 0) + clear.y * lamp(p, n, 1);
    factor = mix(1.0, sqrt(left / all), fade);
}
"""
)

# Nobody is seen.
BLANK = """#version 330
out vec2 seen;
void main() { seen = vec2(0.0); }
"""

BASE = (
    "#version 330"
    + TABLE
    + """
uniform sampler2D seen, room_seen, room_colour, shadow, cones, painted;
uniform float per_step;
layout(location = 0) out vec4 colour;
layout(location = 1) out uint depth;
layout(location = 2) out float id;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 hit = texelFetch(seen, at, 0).rg;
    bool person = hit.y > 0.5;
    float t = person ? hit.x : texelFetch(room_seen, at, 0).r;
    float steps = floor(t * per_step + 0.5);
    depth = steps < 65535.5 ? uint(steps) : 0u;
    id = person ? texelFetch(cones, table_place(int(hit.y - 0.5), 3, 9), 0).w / 255.0 : 0.0;
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    vec3 room = texelFetch(room_colour, at, 0).rgb * dark;
    colour = vec4(person ? texelFetch(painted, at, 0).rgb : room, 1.0);
    MARK
}
"""
)

# Marks outlines in the depth buffer for SMOOTH; put in place of MARK where outlines are antialiased.
MARK = """
    ivec2 most = textureSize(seen, 0) - 1;
    bool edge = texelFetch(seen, min(at + ivec2(1, 0), most), 0).g != hit.y;
    edge = edge || texelFetch(seen, max(at - ivec2(1, 0), 0), 0).g != hit.y;
    edge = edge || texelFetch(seen, min(at + ivec2(0, 1), most), 0).g != hit.y;
    edge = edge || texelFetch(seen, max(at - ivec2(0, 1), 0), 0).g != hit.y;
    gl_FragDepth = edge ? 0.0 : 1.0;
"""

# Where nobody is or was, only the shadow on the room may have changed.
DIM = """#version 330
uniform sampler2D seen, room_colour, shadow;
out vec4 colour;
void main() {
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    colour = vec4(texelFetch(room_colour, ivec2(gl_FragCoord.xy), 0).rgb * dark, 1.0);
}
"""

# Light on a person: `open` is how much the rest of the body leaves free, `toward` the way to the camera.
_LIT = """
vec3 lit(vec3 albedo, float gloss, vec3 at, vec3 n, vec3 toward, float open) {
    float light = open * sky(n) * (0.75 + 0.25 * smoothstep(0.0, 0.9, at.z)), shine = 0.0;
    for (int k = 0; k < 2; ++k) {
        light += (0.35 + 0.65 * open) * lamp(at, n, k);
        float glint = max(dot(n, normalize(normalize(lamps[k] - at) + toward)), 0.0);
        glint *= glint; glint *= glint; glint *= glint; glint *= glint;
        shine += glint * glint;
    }
    return display(albedo * light * 1.08 + gloss * shine * 0.35);
}
"""

PAINT = (
    TABLE
    + """
uniform sampler2D seen, cones, balls;
uniform mat3 to_room;
uniform vec3 eye;
out vec4 colour;

vec4 cone_texel(int index, int part) { return texelFetch(cones, table_place(index, part, 9), 0); }

// Distance of p to a cone, its outward gradient, how far along its axis p lies, and the place on its ball there.
float cone_distance(vec3 p, int index, out vec3 gradient, out float along, out vec3 place) {
    vec4 a = cone_texel(index, 0), b = cone_texel(index, 1), bulge = cone_texel(index, 2);
    vec3 q = p + bulge.w * bulge.xyz * dot(bulge.xyz, p - cone_texel(index, 3).xyz) - a.xyz;
    vec3 axis = b.xyz - a.xyz;
    float length2 = max(dot(axis, axis), 1e-12), taper = a.w - b.w;
    float x = dot(q, axis) / length2, radial = length(q - x * axis);
    // The nearest ball of those that make up the cone: where the distance to the balls' surfaces is stationary.
    float slope = taper * inversesqrt(max(length2 - taper * taper, 1e-12));
    along = clamp(x - radial * slope * inversesqrt(length2), 0.0, 1.0);
    place = q - along * axis;
    float far = length(place);
    gradient = place / max(far, 1e-9);
    gradient = normalize(gradient + bulge.w * bulge.xyz * dot(bulge.xyz, gradient));
    return far - (a.w - along * taper);
}

// For each material: the scales of its two textures, their strengths, how much they bend the surface, and the gloss.
const vec3 COARSE[8] = vec3[8](vec3(45), vec3(22, 22, 30), vec3(16, 16, 9), vec3(150, 150, 14), vec3(30),
                               vec3(22, 22, 30), vec3(22, 22, 30), vec3(30));
const vec3 FINE[8] = vec3[8](vec3(150), vec3(420), vec3(500, 500, 160), vec3(420, 420, 30), vec3(90), vec3(420),
                             vec3(420), vec3(90));
const vec4 GRAIN[8] = vec4[8](vec4(0.10, 0.04, 0.0, 0.035), vec4(0.24, 0.12, 0.20, 0.0), vec4(0.34, 0.25, 0.1, 0.0),
                              vec4(0.60, 0.45, 0.0, 0.10), vec4(0.1, 0.05, 0.0, 0.16), vec4(0.24, 0.12, 0.20, 0.0),
                              vec4(0.24, 0.12, 0.20, 0.0), vec4(0.0, 0.0, 0.0, 0.3));

vec3 shade(vec3 d, float t, int index) {
    vec3 p = t * d, normal, g, place, unused;
    float along, other;
    cone_distance(p, index, normal, along, place);
    vec4 base = cone_texel(index, 4), beyond = cone_texel(index, 5), front = cone_texel(index, 6);
    vec4 more = cone_texel(index, 7), touching = cone_texel(index, 8);
    vec3 sum = normal;
    for (int k = 0; k < 4; ++k) {
        int neighbour = int(touching[k] + 0.5);
        float apart = cone_distance(p, max(neighbour, 0), g, other, unused);
        sum += touching[k] < -0.5 ? vec3(0.0) : exp(-max(apart, 0.0) / 0.016) * g;
    }
    normal = normalize(sum);
    // Coordinates that move with the part: to its front, to its side, and along it.
    vec3 axis = cone_texel(index, 1).xyz - cone_texel(index, 0).xyz;
    float extent = length(axis);
    axis = extent > 1e-6 ? axis / extent : vec3(0.0, -1.0, 0.0);
    vec3 ahead = normalize(front.xyz - axis * dot(front.xyz, axis) + 1e-6), side = cross(axis, ahead);
    vec3 local = vec3(dot(place, ahead), dot(place, side), along * extent);
    float hem = 0.7 * t * per_px.x / max(extent, 1e-3), bare = smoothstep(-hem, hem, along - beyond.w);
    vec3 albedo = mix(base.rgb, beyond.rgb, bare);
    int stated = bare > 0.5 ? 0 : int(base.w + 0.5), material = stated & 7;
    vec4 grain = GRAIN[material];
    float large = noise((local + front.w) * COARSE[material]) - 0.5;
    float small = noise((local + front.w) * FINE[material]) - 0.5;
    vec2 band = smoothstep(-0.2, 0.2, sin(vec2(local.z, 1.3 * local.y) * 125.0));
    float print = material == 5 ? smoothstep(-0.15, 0.15, sin(local.z * 209.0) - 0.35) : 0.0;
    print = material == 6 ? 0.30 * (band.x + band.y) : print;
    albedo = mix(albedo, more.rgb, print);
    float look = dot(normalize(place + 1e-9), normalize(front.xyz));
    vec3 iris = look > 0.93 ? vec3(0.01) : look > 0.80 ? vec3(0.12, 0.07, 0.035) : albedo;
    albedo = material == 7 ? iris : albedo;
    // Folds of loose cloth: ridges across the part that wander, deeper here and there.
    float folds = float(stated >> 3), wander = 4.0 * large + 0.37 * front.w;
    float ridge = 46.0 * local.z + 2.4 * sin(21.0 * local.y + wander) + wander;
    float crease = 38.0 * local.y + 2.0 * sin(15.0 * local.z + wander) - wander;
    float deep = folds * (0.5 + large);
    albedo *= 1.0 - deep * (0.10 + 0.05 * sin(ridge) + 0.05 * sin(crease));
    vec3 creased = normalize(normal - deep * (0.42 * cos(ridge) * axis + 0.30 * cos(crease) * side));
    normal = folds > 0.5 ? creased : normal;
    float sharp = min(1.0, 2.2e-3 / (t * per_px.x));
    albedo *= 1.0 + grain.x * large + grain.y * sharp * small;
    normal = normalize(normal + grain.z * large * (dot(normal, side) > 0.0 ? side : -side));
    vec3 n = to_room * normal, at = eye + to_room * p;
    float open = 1.0;
    int first = int(more.w + 0.5);
    for (int j = 0; j < 8; ++j) {
        vec4 ball = texelFetch(balls, ivec2(first + j, 0), 0);
        vec3 way = ball.xyz - at;
        float square = dot(way, way);
        open *= 1.0 - 0.8 * max(dot(n, way), 0.0) * inversesqrt(square) * min(ball.w * ball.w / square, 1.0);
    }
    return lit(albedo, grain.w, at, n, -(to_room * d), open);
}
"""
)

SHADE_MAIN = """
void main() {
    vec2 hit = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).rg;
    colour = vec4(shade(ray_of(ivec2(gl_FragCoord.xy)), hit.x, int(max(hit.y, 1.0) - 0.5)), 1.0);
}
"""

SHADE = LENS + CONE + LIGHT + _LIT + PAINT + SHADE_MAIN

# An outline's pixel: how much of it each neighbour's cone covers, in the colour that the neighbour has.
SMOOTH = (
    LENS
    + CONE
    + TABLE
    + """
uniform sampler2D seen, cones, room_seen, room_colour, shadow, painted;
out vec4 colour;
vec4 cone_texel(int index, int part) { return texelFetch(cones, table_place(index, part, 9), 0); }
// A pixel (k = 0) and its four neighbours.
ivec2 neighbour(ivec2 at, int k, ivec2 most) {
    return clamp(at + ivec2(int(k == 1) - int(k == 2), int(k == 3) - int(k == 4)), ivec2(0), most);
}
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(seen, 0) - 1;
    float room = texelFetch(room_seen, at, 0).r;
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    vec3 rays[SAMPLES], colours[SAMPLES];
    float nearest[SAMPLES];
    for (int s = 0; s < SAMPLES; ++s) {
        rays[s] = ray_through(gl_FragCoord.xy - 1.0 + fract(vec2(0.7548776662, 0.5698402910) * float(s + 1)));
        colours[s] = texelFetch(room_colour, at, 0).rgb * dark;
        nearest[s] = room > 0.0 ? room : 1e9;
    }
    // Neighbours whose cones differ, a bit each: most see one or two, which are read and hit once.
    int found[5], wanted = 0;
    for (int k = 0; k < 5; ++k) {
        found[k] = int(texelFetch(seen, neighbour(at, k, most), 0).g + 0.5);
        bool known = found[k] == 0;
        for (int j = 0; j < k; ++j) known = known || found[j] == found[k];
        wanted |= known ? 0 : 1 << k;
    }
    for (int turn = 0; turn < 5 && wanted != 0; ++turn) {
        int k = (wanted & 1) != 0 ? 0 : (wanted & 2) != 0 ? 1 : (wanted & 4) != 0 ? 2 : (wanted & 8) != 0 ? 3 : 4;
        wanted &= wanted - 1;
        ivec2 other = neighbour(at, k, most);
        int index = int(texelFetch(seen, other, 0).g + 0.5) - 1;
        vec4 a = cone_texel(index, 0), b = cone_texel(index, 1), bulge = cone_texel(index, 2);
        vec3 middle = cone_texel(index, 3).xyz, paint = texelFetch(painted, other, 0).rgb;
        for (int s = 0; s < SAMPLES; ++s) {
            float reach = hit_cone(rays[s], a, b, bulge, middle);
            if (reach > 0.0 && reach < nearest[s]) { nearest[s] = reach; colours[s] = paint; }
        }
    }
    vec3 total = vec3(0.0);
    for (int s = 0; s < SAMPLES; ++s) total += colours[s];
    colour = vec4(room > 0.0 ? total / float(SAMPLES) : vec3(0.0), 1.0);
}
"""
)
