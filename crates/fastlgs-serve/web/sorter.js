// Worker that sorts Gaussians from far to near, by a counting sort over 16 bits of depth.

const STEPS = 1 << 16;
let means = new Float32Array();

onmessage = ({ data }) => {
  if (data.means) {
    means = data.means;
    return;
  }
  const [x, y, z, w] = data.depth; // the row of world_to_camera that gives depth
  const count = means.length / 3;
  const depths = new Float32Array(count);
  let near = Infinity, far = -Infinity, kept = 0;
  for (let i = 0; i < count; i++) {
    // Rounded to float32 like the stored depth, so that no depth is outside near and far.
    const depth = depths[i] = Math.fround(x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w);
    if (depth > 0) {
      kept++;
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
  }
  // Equal steps of log(depth), which are finer close to the camera.
  const range = Math.max(Math.log(far / near), 1e-12);
  const step = (depth) => Math.min(STEPS - 1, Math.floor(Math.log(far / depth) / range * STEPS));
  const starts = new Uint32Array(STEPS + 1);
  const steps = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    if (depths[i] > 0) starts[(steps[i] = step(depths[i])) + 1]++;
  }
  for (let s = 0; s < STEPS; s++) starts[s + 1] += starts[s];
  const order = new Uint32Array(kept);
  for (let i = 0; i < count; i++) {
    if (depths[i] > 0) order[starts[steps[i]]++] = i;
  }
  postMessage({ order, number: data.number }, [order.buffer]);
};
