"""The GLSL programs of the renderer: the shadow map, and the picture with depth and labels.

Software OpenGL works out every branch for every pixel, so each way of painting gets a program of its own, and matt
surfaces go without highlights and reflections (`fragment`). A pattern's GLSL defines `painted` for surfaces in the
light, with what `mirrored` shows in them, or `backdrop` for domes. The street's patterns lie on the walls and floors of
their bodies' frames, in metres. From WOOD on a pattern is solid, a function of the point in the body's frame, so that
it runs on around every corner; it fades into its mean where it would be finer than a pixel.
"""

from gcd_train.scenes.description import DOMES, Pattern

_VERTEX_IN = """
#version 330
uniform sampler2D bodies;  // row b: the three rows of world_from_body of body b
in vec3 position;
vec3 placed(vec4 point, uint body) {
    vec4 x = texelFetch(bodies, ivec2(0, int(body)), 0);
    vec4 y = texelFetch(bodies, ivec2(1, int(body)), 0);
    vec4 z = texelFetch(bodies, ivec2(2, int(body)), 0);
    return vec3(dot(x, point), dot(y, point), dot(z, point));
}
"""

_FRAME = """
layout(std140) uniform Frame {  // as `renderer._Frame` writes it
    mat4 clip_from_world, light_from_world;
    vec4 eye_, ahead_, sun_to_, sun_, sky_, ground_, horizon_, zenith_;
    float fog_m, cloud, exposure, shadow_lift;
};
"""

_NO_SHADOW = " || ".join(f"tags.w == {int(pattern)}u" for pattern in (Pattern.SKY, *DOMES))
SHADOW_VERTEX = (
    _VERTEX_IN
    + _FRAME
    + """
in uvec4 tags;
void main() {
    gl_Position = light_from_world * vec4(placed(vec4(position, 1.0), tags.z), 1.0);
    if (NO_SHADOW) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}
""".replace("NO_SHADOW", _NO_SHADOW)
)
SHADOW_FRAGMENT = """
#version 330
void main() {}
"""

VERTEX = (
    _VERTEX_IN
    + _FRAME
    + """
in vec3 normal;
in vec4 colour, accent;
in uvec4 tags;
out vec3 local, normal_local, world, normal_world, in_light;
out float depth;
flat out vec4 paint, second;
flat out vec3 base_colour, second_colour;
flat out uvec4 labels;
void main() {
    world = placed(vec4(position, 1.0), tags.z);
    normal_world = placed(vec4(normal, 0.0), tags.z);
    local = position;
    normal_local = normal;
    in_light = (light_from_world * vec4(world + shadow_lift * normal_world, 1.0)).xyz * 0.5 + 0.5;
    depth = dot(world - eye_.xyz, ahead_.xyz);
    paint = colour;
    second = accent;
    base_colour = pow(colour.rgb, vec3(2.2));
    second_colour = pow(accent.rgb, vec3(2.2));
    labels = tags;
    gl_Position = clip_from_world * vec4(world, 1.0);
}
"""
)

_FRAGMENT_IN = """
uniform sampler2DShadow shadow;
in vec3 local, normal_local, world, normal_world, in_light;
in float depth;
flat in vec4 paint, second;
flat in vec3 base_colour, second_colour;
flat in uvec4 labels;
layout(location = 0) out vec4 rgb;
layout(location = 1) out vec2 facts;  // depth; class + 256 * instance + 65536 * body
#define eye eye_.xyz
#define sun_to sun_to_.xyz
#define sun sun_.xyz
#define sky sky_.xyz
#define ground ground_.xyz
#define horizon horizon_.xyz
#define zenith zenith_.xyz

float hash(vec2 p) { return fract(61.7 * fract(dot(p, vec2(0.7543, 0.5698)) + 0.137 * p.x * p.y)); }
float noise(vec2 p) {
    vec2 i = floor(p), f = fract(p);
    f = f * f * (3.0 - 2.0 * f);
    return mix(mix(hash(i), hash(i + vec2(1, 0)), f.x), mix(hash(i + vec2(0, 1)), hash(i + vec2(1, 1)), f.x), f.y);
}
vec3 sky_colour(vec3 ray) {
    float up = clamp(ray.z, 0.0, 1.0);
    vec3 clear = mix(horizon, zenith, pow(up, 0.55));
    vec2 at = ray.xy / (up + 0.15);
    float puff = smoothstep(0.45, 0.8, noise(at * 1.6) * 0.7 + noise(at * 4.0) * 0.3);
    return mix(clear, vec3(0.85), cloud * puff * smoothstep(0.02, 0.2, up));
}
vec3 seen(vec3 light) { return pow(1.0 - exp(-exposure * light), vec3(1.0 / 2.2)); }
"""

_BEHIND_MAIN = """
void main() {
    rgb = vec4(seen(backdrop(normalize(world - CENTRE))), 1.0);
    facts = vec2(FAR, float(labels.x + 256u * labels.y + 65536u * labels.z));
}
"""

_MAIN = """
float lit() {
    if (any(lessThan(in_light, vec3(0.0))) || any(greaterThan(in_light, vec3(1.0)))) return 1.0;
    return texture(shadow, vec3(in_light.xy, in_light.z - 0.0012));  // filtered over 2 x 2 by the sampler
}
void main() {
    vec3 ray = normalize(world - eye);
    float gloss;
    vec3 base = painted(base_colour, gloss);
    vec3 n = normalize(normal_world);
    float facing = max(dot(n, sun_to), 0.0);
    float in_sun = facing > 0.0 ? lit() : 0.0;
    vec3 light = sun * facing * in_sun + mix(ground, sky, 0.5 + 0.5 * n.z);
    vec3 colour = base * light;
#ifdef GLOSSY
    vec3 half_way = normalize(sun_to - ray);
    colour += gloss * in_sun * sun * 0.5 * pow(max(dot(n, half_way), 0.0), 30.0);
    colour += gloss * 0.25 * mirrored(reflect(ray, n)) * pow(1.0 - max(dot(-ray, n), 0.0), 2.0);
#endif
#ifdef LIT
    colour = base * 2.5;
#endif
    float far = distance(world, eye) / fog_m;
    colour = mix(colour, horizon, 1.0 - exp2(-far * far));
    rgb = vec4(seen(colour), 1.0);
    facts = vec2(depth, float(labels.x + 256u * labels.y + 65536u * labels.z));
}
"""

_WALL_HEAD = """
vec2 on_wall(vec3 n) {
    return abs(n.z) < 0.5 ? vec2(dot(local.xy, normalize(vec2(-n.y, n.x) + 1e-5)), local.z) : local.xy;
}
vec3 mirrored(vec3 ray) { return sky_colour(ray); }
vec3 painted(vec3 base, out float gloss) {
    gloss = paint.a;
    vec3 n = normalize(normal_local);
    vec2 wall = on_wall(n);
"""

_SOLID_HEAD = """
float grain() { return 0.02 * exp2(8.0 * second.a); }
vec3 tint() { return second_colour; }
float own() { return float(labels.y) * 7.31; }  // so that two things of a kind differ
vec3 wide(vec3 p) { return abs(dFdx(p)) + abs(dFdy(p)); }  // how much of the pattern a pixel covers
float noise3(vec3 p) {  // two sheets of noise across each other are cheaper than a noise in space
    return 0.5 * (noise(p.xy + 1.7 * p.z) + noise(vec2(p.y - 0.7 * p.x, 0.9 * p.x - 1.3 * p.z) + 5.2));
}
vec3 mirrored(vec3 ray) { return mix(horizon, zenith, sqrt(clamp(ray.z, 0.0, 1.0))); }  // clouds would cost more
float blurred(float share, float pixel) { return mix(share, 0.5, smoothstep(0.4, 1.0, pixel)); }
float stripe(float x, float pixel) {  // 0 or 1 by turns, each half a unit wide, with soft edges
    float edge = clamp(pixel, 0.004, 0.25);
    float wave = abs(fract(x) - 0.5);
    return blurred(smoothstep(0.25 - edge, 0.25 + edge, wave), pixel);
}
vec3 painted(vec3 base, out float gloss) {
    gloss = paint.a;
    vec3 p = local / grain();
"""

_BACKDROP_HEAD = """
float ridge(vec2 way, float many) {  // height of a skyline at a direction on the ground
    return 0.6 * noise(way * many + 3.1) + 0.28 * noise(way * many * 2.7) + 0.12 * noise(way * many * 7.9);
}
vec3 backdrop(vec3 ray) {
    vec2 way = normalize(ray.xy + 1e-6);
    float up = ray.z, turn = atan(way.y, way.x);
    vec3 far_colour = mix(base_colour, horizon, 0.55), near_colour = mix(second_colour, horizon, 0.25);
"""

_ON_WALL = {
    **dict.fromkeys((Pattern.PLAIN, Pattern.LIT), "    return base;"),
    Pattern.SPECKLE: "    return base * (0.86 + 0.2 * noise(wall * 1.7) + 0.1 * noise(wall * 0.31));",
    Pattern.LEAVES: "    return base * (0.6 + 0.75 * noise(wall * 2.3 + n.xy * 3.0));",
    Pattern.WINDOWS: """
    if (abs(n.z) < 0.5) {  // spacing and size follow from the wall's colour
        float wide = 2.2 + 2.0 * fract(paint.r * 37.0), high = 2.9 + 0.6 * fract(paint.g * 53.0);
        vec2 cell = fract(vec2(wall.x / wide, wall.y / high));
        vec2 share = vec2(0.35 + 0.45 * fract(paint.b * 71.0), 0.5);
        vec2 off = abs(cell - vec2(0.5, 0.55));
        if (off.x < share.x * 0.5 && off.y < share.y * 0.5 && wall.y > 0.6) {
            gloss = 0.6;
            return mix(vec3(0.03, 0.04, 0.06), sky * 0.35, 0.4 * hash(floor(vec2(wall.x / wide, wall.y / high))));
        }
        return base * (0.94 + 0.06 * step(0.06, fract(wall.y / high)));
    }
    return base;""",
    Pattern.TILES: """
    vec2 cell = fract(wall / 1.2);
    float seam = step(0.05, cell.x) * step(0.05, cell.y);
    return base * (0.82 + 0.12 * seam + 0.1 * hash(floor(wall / 1.2)));""",
    Pattern.BRICK: """
    float row = floor(wall.y / 0.6);
    vec2 cell = fract(vec2(wall.x / 1.4 + 0.5 * mod(row, 2.0), wall.y / 0.6));
    return base * (0.85 + 0.15 * step(0.12, cell.y) * step(0.06, cell.x));""",
}

_SOLID = {
    Pattern.WOOD: """
    vec3 q = p + 0.35 * noise(p.yz * 0.8 + own());
    float rings = length(q.xy) * 2.0 + 0.5 * noise(vec2(q.z * 0.35, own()));
    float pixel = 2.0 * max(wide(p).x, wide(p).y);
    float dark = smoothstep(0.15, 0.95, fract(rings)) * (1.0 - smoothstep(0.95, 1.0, fract(rings)));
    float fibre = 0.12 * (noise(vec2(20.0 * rings, 1.5 * p.z)) - 0.5);
    return mix(base, tint(), blurred(dark, pixel) * 0.75) * (1.0 + fibre);""",
    Pattern.MARBLE: """
    float swirl = 3.0 * noise3(p * 1.3 + own()) + 1.2 * noise3(p * 3.1);
    float vein = 1.0 - abs(2.0 * fract(0.35 * (p.x + p.y + p.z) + 0.6 * swirl) - 1.0);
    return mix(base, tint(), smoothstep(0.72, 1.0, vein) * 0.9 + 0.18 * noise3(p * 0.9));""",
    Pattern.CHECKER: """
    vec3 pixel = wide(p);
    vec3 side = vec3(stripe(0.5 * p.x + 0.13, pixel.x), stripe(0.5 * p.y + 0.13, pixel.y),
        stripe(0.5 * p.z + 0.13, pixel.z));
    vec3 odd = 2.0 * side - 1.0;
    return mix(base, tint(), 0.5 + 0.5 * odd.x * odd.y * odd.z);""",
    Pattern.STRIPES: """
    float along = fract(own()) < 0.5 ? p.z : p.x + 0.35 * p.y;
    return mix(base, tint(), stripe(along, max(wide(p).x, wide(p).z)));""",
    Pattern.CLOUDY: """
    float pixel = max(wide(p).x, max(wide(p).y, wide(p).z));
    float fine = mix(noise3(4.7 * p), 0.5, smoothstep(0.08, 0.3, pixel));
    float soft = 0.35 * noise3(0.31 * p + own()) + 0.4 * mix(noise3(p), 0.5, smoothstep(0.3, 1.0, pixel)) + 0.25 * fine;
    return mix(base, tint(), smoothstep(0.3, 0.7, soft));""",
    Pattern.DOTS: """
    vec3 cell = fract(p + 0.25) - 0.5;
    vec3 pixel = wide(p);
    float size = max(pixel.x, max(pixel.y, pixel.z));
    float dot_ = 1.0 - smoothstep(0.33 - size, 0.33 + size, length(cell));
    return mix(base, tint(), mix(dot_, 0.25, smoothstep(0.5, 1.2, size)));""",
    Pattern.PLANKS: """
    float row = floor(p.y), pixel = max(wide(p).x, wide(p).y);
    float shift = hash(vec2(row, 3.0));
    vec2 board = vec2(floor(p.x / 6.0 + 5.0 * shift), row);
    vec2 at = vec2(fract(p.x / 6.0 + 5.0 * shift) * 6.0, fract(p.y));
    float seam = smoothstep(0.0, 0.03 + pixel, min(min(at.x, 6.0 - at.x), min(at.y, 1.0 - at.y)));
    float fibre = noise(vec2(p.x * 1.1 + 40.0 * hash(board), p.y * 9.0)) * (1.0 - smoothstep(0.05, 0.25, pixel));
    vec3 tone = mix(base, tint(), 0.65 * hash(board) + 0.3 * fibre);
    return tone * mix(0.45 + 0.55 * seam, 0.93, smoothstep(0.2, 0.8, pixel));""",
    Pattern.TERRAZZO: """
    vec2 q = p.xy + 0.7 * p.z;
    vec2 cell = floor(q), at = fract(q) - 0.5;
    float pixel = max(wide(p).x, wide(p).y);
    vec2 off = 0.5 * (vec2(hash(cell), hash(cell + 17.0)) - 0.5);
    float chip = 1.0 - smoothstep(0.0, 0.1 + pixel, abs(at.x - off.x) + abs(at.y - off.y) - 0.34 * hash(cell + 5.0));
    vec3 kind = mix(tint(), base * 0.35, step(0.6, hash(cell + 9.0)));
    return mix(base, kind, mix(chip, 0.22, smoothstep(0.5, 1.3, pixel)) * 0.85);""",
}

_BACKDROPS = {
    Pattern.SKY: "    return sky_colour(ray);",
    Pattern.HILLS: """
    float far_row = 0.05 + 0.17 * ridge(way, 2.2), near_row = 0.01 + 0.11 * ridge(way + 7.0, 4.3);
    vec3 open = mix(far_colour * (0.9 + 0.2 * noise(vec2(turn * 30.0, up * 60.0))), sky_colour(ray),
        smoothstep(far_row - 0.004, far_row + 0.004, up));
    vec3 wood = near_colour * (0.7 + 0.6 * noise(vec2(turn * 70.0, up * 90.0)));
    return mix(wood, open, smoothstep(near_row - 0.006, near_row + 0.006, up + 0.012 * noise(way * 60.0)));""",
    Pattern.HOUSES: """
    float a = turn * 5.411, b = turn * 8.913 + 0.4;  // 34 and 56 houses around
    float far_row = 0.08 + 0.2 * hash(vec2(floor(b), 2.0)), near_row = 0.02 + 0.16 * hash(vec2(floor(a), 7.0));
    vec2 pane = fract(vec2(a * 9.0, up * 70.0)) - 0.5;
    float window = step(abs(pane.x), 0.28) * step(abs(pane.y), 0.3);
    vec3 wall = mix(base_colour, second_colour, hash(vec2(floor(a), 4.0)));
    wall = mix(wall, vec3(0.05, 0.06, 0.08), 0.8 * window);
    vec3 distant = mix(far_colour, horizon, 0.3 + 0.3 * hash(vec2(floor(b), 9.0)));
    return up < near_row ? mix(wall, horizon, 0.2) : up < far_row ? distant : sky_colour(ray);""",
    Pattern.HALL: """
    float pane = fract(turn * 3.8197) - 0.5;  // 24 windows around
    float frame = step(abs(pane), 0.33) * step(0.1, up) * step(up, 0.36) * step(0.02, abs(pane));
    float panel = step(0.48, abs(fract(turn * 7.6394) - 0.5)) * step(up, 0.1);
    vec3 wall = mix(second_colour, base_colour, smoothstep(0.085, 0.09, up)) * (1.0 - 0.35 * panel);
    wall = mix(wall, base_colour * 0.5, smoothstep(0.5, 0.52, up));
    return mix(wall * (sky + ground), sky_colour(ray) * 1.1 + 0.1, frame);""",
    Pattern.STUDIO: """
    float soft = smoothstep(0.0, 0.5, up + 0.06 * sin(2.0 * turn));
    return mix(base_colour, second_colour, soft) * (sky + 0.5 * ground) * (1.0 + 0.3 * sin(turn + 1.0));""",
}


def fragment(pattern: Pattern, *, glossy: bool) -> str:
    """The fragment shader that paints one pattern, with highlights and reflections or without."""
    if pattern in _BACKDROPS:
        is_sky = pattern is Pattern.SKY
        main = _BEHIND_MAIN.replace("CENTRE", "eye" if is_sky else "0.0").replace("FAR", "0.0" if is_sky else "depth")
        paint = _BACKDROP_HEAD + _BACKDROPS[pattern] + "}" + main
    elif pattern in _SOLID:
        paint = _SOLID_HEAD + _SOLID[pattern] + "}" + _MAIN
    else:
        paint = _WALL_HEAD + _ON_WALL[pattern] + "}" + _MAIN
    defines = [f"#define {name}" for name, on in (("GLOSSY", glossy), ("LIT", pattern is Pattern.LIT)) if on]
    return "\n".join(["#version 330", *defines]) + _FRAME + _FRAGMENT_IN + paint
