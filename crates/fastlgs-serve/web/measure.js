// Points of the scene under a pixel, and lengths between them.

// As src/splats.rs packs them.
const LOG_SCALE_LOW = -20, LOG_SCALE_RANGE = 30;
// What lies behind less than this much light counts as seen.
const SOLID = 0.5;
const NEAR = 0.5; // splat.wgsl draws no Gaussian that is nearer than so many of its sizes
const FAINT = 1 / 255; // nor what adds less than one grey level

// The rotation of a Gaussian as a matrix, row by row; unpack_rotation of splat.wgsl tells how it is packed.
function rotation(low, high) {
  const v = [(low & 0xffff) / 65535, (low >>> 16) / 65535, (high & 0x3fff) / 16383].map((part) => (part * 2 - 1) * Math.SQRT1_2);
  v.splice((high >>> 14) & 3, 0, Math.sqrt(Math.max(1 - v[0] ** 2 - v[1] ** 2 - v[2] ** 2, 0)));
  const [w, x, y, z] = v;
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// Where along a ray a Gaussian is densest, and how much light it takes there; nothing where it hardly touches the ray. `pixel` is what
// a pixel covers at distance 1: nothing is thinner.
function crossing({ data, texels, means }, i, { eye, forward }, direction, pixel) {
  const at = 4 * texels * i;
  const offset = [0, 1, 2].map((k) => eye[k] - means[3 * i + k]);
  const reach = -dot(offset, direction) / dot(direction, direction);
  if (!(reach > 0)) return null;
  const log = [data[at + 3] & 0xffff, data[at + 3] >>> 16, data[at + 4] & 0xffff];
  const sizes = log.map((bits) => Math.exp(bits / 65535 * LOG_SCALE_RANGE + LOG_SCALE_LOW));
  if (!(-dot(offset, forward) > NEAR * Math.hypot(...sizes))) return null;
  const scales = sizes.map((size) => Math.max(size, 0.5 * pixel * reach));
  const passing = Math.hypot(...[0, 1, 2].map((k) => offset[k] + reach * direction[k]));
  if (passing > 3.4 * Math.max(...scales)) return null;
  const r = rotation(data[at + 6], data[at + 7]);
  const column = (k) => [r[0][k], r[1][k], r[2][k]];
  const p = scales.map((s, k) => dot(column(k), offset) / s);
  const q = scales.map((s, k) => dot(column(k), direction) / s);
  const depth = -dot(p, q) / dot(q, q);
  const alpha = (data[at + 4] >>> 16) / 65535 * Math.exp(-0.5 * (dot(p, p) - dot(p, q) ** 2 / dot(q, q)));
  return depth > 0 && alpha >= FAINT ? { depth, alpha } : null;
}

// The point of the surface that a pixel shows; nothing where one looks through the scene. `shown` tells which objects there are.
export function pointAt(splats, camera, lens, x, y, shown) {
  const direction = camera.ray(x, y, lens);
  const crossings = [];
  for (let i = 0; i < splats.count; i++) {
    const hit = crossing(splats, i, camera, direction, 1 / lens.fx);
    if (hit && shown(splats.data[4 * splats.texels * i + 7] >>> 16)) crossings.push(hit);
  }
  crossings.sort((a, b) => a.depth - b.depth);
  let light = 1;
  for (const { depth, alpha } of crossings) {
    light *= 1 - alpha;
    if (light < SOLID) return camera.eye.map((v, k) => v + depth * direction[k]);
  }
  return null;
}

// Two points and what lies between them. Scenes that were made from photos have no unit of their own, until a length is known.
export class Measure {
  constructor(scene) {
    this.key = `fastlgs unit ${location.pathname} ${scene}`;
    this.points = [];
    this.on = false;
    try {
      this.unit = Number(localStorage.getItem(this.key)) || null;
    } catch {
      this.unit = null;
    }
  }

  // A third point begins anew.
  add(point) {
    this.points = this.points.length === 2 ? [point] : [...this.points, point];
  }

  length() {
    const [a, b] = this.points;
    return b ? Math.hypot(...a.map((v, k) => v - b[k])) : null;
  }

  text() {
    const length = this.length();
    if (length === null) return "";
    return this.unit ? `${Number((length * this.unit).toPrecision(3))} m` : `${Number(length.toPrecision(3))} units`;
  }

  // The length between the points is `metres` in truth; without a number it is unknown again.
  known(metres) {
    const length = this.length();
    this.unit = metres > 0 && length > 0 ? metres / length : null;
    try {
      if (this.unit) localStorage.setItem(this.key, this.unit);
      else localStorage.removeItem(this.key);
    } catch {
      // Then it is known until the page is closed.
    }
  }
}
