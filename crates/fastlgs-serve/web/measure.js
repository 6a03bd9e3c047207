// Surface points under pixels, and lengths between them.

// Range of log-scales, as in src/splats.rs.
const LOG_SCALE_LOW = -20, LOG_SCALE_RANGE = 30;
// The surface is where the transmittance falls below this value.
const SURFACE_TRANSMITTANCE = 0.5;
const NEAR = 0.5; // least depth of a drawn Gaussian relative to its size, as in splat.wgsl
const FAINT = 1 / 255; // least alpha of a drawn Gaussian: one grey level

// Returns the rotation of a Gaussian as a matrix, by rows. unpack_rotation of splat.wgsl defines
// the packing.
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

// Returns depth and alpha of a Gaussian where it is densest along a ray, or null if alpha is too
// small. `pixel` is the width of a pixel at distance 1; scales are at least half a pixel.
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

// Returns the surface point at a canvas position, or null if there is no surface. `shown` returns
// whether a Gaussian id is visible.
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
    if (light < SURFACE_TRANSMITTANCE) return camera.eye.map((v, k) => v + depth * direction[k]);
  }
  return null;
}

// Measures the length between two points. Scenes from photos have no metric unit until the user
// enters a real length.
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

  // A third point starts a new measurement.
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

  // Sets the real length between the points in metres. Without a positive number, the unit becomes
  // unknown.
  known(metres) {
    const length = this.length();
    this.unit = metres > 0 && length > 0 ? metres / length : null;
    try {
      if (this.unit) localStorage.setItem(this.key, this.unit);
      else localStorage.removeItem(this.key);
    } catch {
      // Without storage, the unit is lost when the page is closed.
    }
  }
}
