// The camera of the page: a pinhole (x right, y down, looking along +z) that orbits a target point.

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

// Smallest distance for overlays and for zooming, relative to the distance of the view's subject.
const MIN_DISTANCE = 0.002;

// Rotates v about a unit axis by an angle in radians (Rodrigues).
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

export class Camera {
  constructor(up) {
    this.up = unit(up);
  }

  // Moves to a view of the scene, and uses its intrinsics from then on.
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

  // Returns nine numbers: position, target point and down direction.
  pose() {
    return [...this.eye, ...this.target(), ...this.down];
  }

  // Sets the pose from the numbers of `pose`. Returns false if they are not a valid pose.
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

  // Returns the ray of a canvas position in scene coordinates, with a depth of 1.
  ray(x, y, lens) {
    return add(add(this.forward, this.right, (x - lens.cx) / lens.fx), this.down, (y - lens.cy) / lens.fy);
  }

  turn(yaw, pitch) {
    const target = this.target();
    const both = (v) => turned(turned(v, this.right, pitch), this.up, yaw);
    const polarCosine = (v) => Math.abs(dot(unit(v), this.up));
    const tilted = polarCosine(turned(this.forward, this.right, pitch));
    // Beyond the pole the picture would be upside down. A view that starts closer to the pole may
    // still turn away.
    if (pitch !== 0 && tilted > Math.max(0.985, polarCosine(this.forward))) return this.turn(yaw, 0);
    [this.forward, this.down] = [unit(both(this.forward)), unit(both(this.down))];
    this.right = unit(cross(this.down, this.forward));
    this.down = unit(cross(this.forward, this.right));
    this.eye = add(target, this.forward, -this.distance);
    this.moved = true;
  }

  // Moves by shares of the image height, at the distance of the target.
  move(x, y) {
    const step = this.distance * this.view.height / this.view.fy;
    this.eye = add(add(this.eye, this.right, -x * step), this.down, -y * step);
    this.moved = true;
  }

  zoom(factor) {
    const target = this.target();
    this.distance = Math.max(this.distance * factor, MIN_DISTANCE * this.view.focus);
    this.eye = add(target, this.forward, -this.distance);
    this.moved = true;
  }

  worldToCamera() {
    const { right: r, down: d, forward: f, eye } = this;
    return [r[0], d[0], f[0], 0, r[1], d[1], f[1], 0, r[2], d[2], f[2], 0, -dot(r, eye), -dot(d, eye), -dot(f, eye), 1];
  }

  // Returns focal lengths and principal point for a canvas into which the view is fitted, and the
  // rectangle of the view in it, in pixels.
  lens(width, height) {
    const { view } = this;
    const scale = Math.min(width / view.width, height / view.height);
    const left = (width - view.width * scale) / 2, top = (height - view.height * scale) / 2;
    return {
      fx: view.fx * scale, fy: view.fy * scale, cx: left + view.cx * scale, cy: top + view.cy * scale,
      picture: { left, top, width: view.width * scale, height: view.height * scale },
    };
  }

  // Returns the camera of the whole canvas for the server, with at most `side` pixels along its
  // longer side.
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

  // Returns the canvas position of a scene point, or null if it is behind or too close to the
  // camera.
  project(point, lens) {
    const v = add(point, this.eye, -1);
    const z = dot(v, this.forward);
    return z > MIN_DISTANCE * this.view.focus ? [lens.fx * dot(v, this.right) / z + lens.cx, lens.fy * dot(v, this.down) / z + lens.cy] : null;
  }
}

// Returns the apex and the corners of a view's frustum with this depth, in scene coordinates.
export function frustum(view, depth) {
  const m = view.world_to_camera;
  const toWorld = (p) => {
    const q = add(p, [m[12], m[13], m[14]], -1);
    return [dot([m[0], m[1], m[2]], q), dot([m[4], m[5], m[6]], q), dot([m[8], m[9], m[10]], q)];
  };
  const corner = ([x, y]) => toWorld([(x - view.cx) / view.fx * depth, (y - view.cy) / view.fy * depth, depth]);
  return { apex: toWorld([0, 0, 0]), corners: [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]].map(corner) };
}
