// Shared by all renderers: the parser of the Gaussians, and the uniform of splat.wgsl.

export const ROW = 2048; // texels per row; splat.wgsl must have the same number
export const OBJECT_ROWS = 512; // 256 rows of states, 256 rows of colours
export const MODES = { color: 0, relevancy: 1, objects: 2, ids: 3 };
const MAGIC = 0x53474c46, VERSION = 1, HEADER = 32;

// Parses the data of /api/splats. Returns the texels, padded to whole rows, and the means for
// sorting.
export function parseSplats(buffer) {
  const [magic, version, count, shDegree, texels] = new Uint32Array(buffer, 0, 5);
  const [colorRange, shRange] = new Float32Array(buffer, 20, 2);
  if (magic !== MAGIC || version !== VERSION) throw new Error("the server sends the Gaussians in another version of the format; reload the page");
  const rows = Math.max(1, Math.ceil(count * texels / ROW));
  const data = new Uint32Array(rows * ROW * 4);
  data.set(new Uint32Array(buffer, HEADER));
  const floats = new Float32Array(data.buffer);
  const means = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) means.set(floats.subarray(4 * texels * i, 4 * texels * i + 3), 3 * i);
  return { data, rows, means, count, shDegree, texels, colorRange, shRange };
}

// Packs the uniform `Frame` of splat.wgsl.
export function packFrame({ camera, width, height, scene, splats, mode, dim }) {
  const buffer = new ArrayBuffer(128);
  const lens = camera.lens(width, height);
  new Float32Array(buffer).set([
    ...camera.worldToCamera(), ...camera.eye, scene.antialias ? 1 : 0, lens.fx, lens.fy, lens.cx, lens.cy,
    width, height, splats.colorRange, splats.shRange,
  ]);
  new Uint32Array(buffer, 112).set([MODES[mode], splats.shDegree, dim ? 1 : 0, splats.texels]);
  return buffer;
}
