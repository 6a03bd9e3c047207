// The camera of the page: a pinhole (x right, y down, looking along +z) that turns about a point before it.

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

// What lies nearer than this share of the distance at which a view's things are is not shown; and so near one may come.
const NEAREST = 0.002;

// Turns v about a unit axis (Rodrigues).
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

export class Camera {
  constructor(up) {
    this.up = unit(up);
  }

  // Takes the place of a view of the scene, whose lens it keeps from then on.
  lookFrom(view) {
    const m = view.world_to_camera;
    this.right = [m[0], m[4], m[8]];
    this.down = [m[1], m[5], m[9]];
    this.forward = [m[2], m[6], m[10]];
    const t = [m[12], m[13], m[14]];
    this.eye = scaled(add(add(scaled(this.right, t[0]), this.down, t[1]), this.forward, t[2]), -1);
    this.distance = view.focus;
    this.view = view;
    this.moved = false;
  }

  target() {
    return add(this.eye, this.forward, this.distance);
  }

  // Where it stands, what it turns about, and which way is down: nine numbers.
  pose() {
    return [...this.eye, ...this.target(), ...this.down];
  }

  // Takes a pose; whether it is one.
  stand(pose) {
    const [eye, target, down] = [pose.slice(0, 3), pose.slice(3, 6), pose.slice(6, 9)];
    const forward = add(target, eye, -1);
    const right = cross(down, forward);
    const apart = Math.hypot(...forward), wide = Math.hypot(...right);
    if (pose.length !== 9 || !(apart > 1e-6) || !(wide > 1e-6 * apart)) return false;
    Object.assign(this, { eye, distance: apart, forward: unit(forward), right: unit(right), moved: true });
    this.down = unit(cross(this.forward, this.right));
    return true;
  }

  // Direction in the world of what a place of the canvas shows, one unit deep.
  ray(x, y, lens) {
    return add(add(this.forward, this.right, (x - lens.cx) / lens.fx), this.down, (y - lens.cy) / lens.fy);
  }

  turn(yaw, pitch) {
    const target = this.target();
    const both = (v) => turned(turned(v, this.right, pitch), this.up, yaw);
    const steep = (v) => Math.abs(dot(unit(v), this.up));
    const tilted = steep(turned(this.forward, this.right, pitch));
    // Over the pole everything would stand on its head; a photo that was taken towards it may be left.
    if (pitch !== 0 && tilted > Math.max(0.985, steep(this.forward))) return this.turn(yaw, 0);
    [this.forward, this.down] = [unit(both(this.forward)), unit(both(this.down))];
    this.right = unit(cross(this.down, this.forward));
    this.down = unit(cross(this.forward, this.right));
    this.eye = add(target, this.forward, -this.distance);
    this.moved = true;
  }

  // Moves by parts of the picture's height.
  move(x, y) {
    const step = this.distance * this.view.height / this.view.fy;
    this.eye = add(add(this.eye, this.right, -x * step), this.down, -y * step);
    this.moved = true;
  }

  zoom(factor) {
    const target = this.target();
    this.distance = Math.max(this.distance * factor, NEAREST * this.view.focus);
    this.eye = add(target, this.forward, -this.distance);
    this.moved = true;
  }

  worldToCamera() {
    const { right: r, down: d, forward: f, eye } = this;
    return [r[0], d[0], f[0], 0, r[1], d[1], f[1], 0, r[2], d[2], f[2], 0, -dot(r, eye), -dot(d, eye), -dot(f, eye), 1];
  }

  // Focal lengths and principal point for a canvas into which the view's picture is fitted, and where that picture lies in it.
  lens(width, height) {
    const { view } = this;
    const scale = Math.min(width / view.width, height / view.height);
    const left = (width - view.width * scale) / 2, top = (height - view.height * scale) / 2;
    return {
      fx: view.fx * scale, fy: view.fy * scale, cx: left + view.cx * scale, cy: top + view.cy * scale,
      picture: { left, top, width: view.width * scale, height: view.height * scale },
    };
  }

  // What the server takes as a camera: the whole canvas, with at most `side` pixels along its longer side.
  asJson(width, height, side = Infinity) {
    const shrink = Math.min(1, side / Math.max(width, height));
    const size = [width, height].map((n) => Math.max(1, Math.round(n * shrink)));
    const lens = this.lens(width, height);
    const [sx, sy] = [size[0] / width, size[1] / height];
    return {
      name: this.moved ? "page" : this.view.name, width: size[0], height: size[1],
      fx: lens.fx * sx, fy: lens.fy * sy, cx: lens.cx * sx, cy: lens.cy * sy,
      world_to_camera: this.worldToCamera(),
    };
  }

  // Canvas position of a point of the world; nothing behind the camera.
  project(point, lens) {
    const v = add(point, this.eye, -1);
    const z = dot(v, this.forward);
    return z > NEAREST * this.view.focus ? [lens.fx * dot(v, this.right) / z + lens.cx, lens.fy * dot(v, this.down) / z + lens.cy] : null;
  }
}

// Apex and corners of a view's frustum in the world, `depth` deep.
export function frustum(view, depth) {
  const m = view.world_to_camera;
  const toWorld = (p) => {
    const q = add(p, [m[12], m[13], m[14]], -1);
    return [dot([m[0], m[1], m[2]], q), dot([m[4], m[5], m[6]], q), dot([m[8], m[9], m[10]], q)];
  };
  const corner = ([x, y]) => toWorld([(x - view.cx) / view.fx * depth, (y - view.cy) / view.fy * depth, depth]);
  return { apex: toWorld([0, 0, 0]), corners: [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]].map(corner) };
}
