// Which way of drawing is taken.

import { openWebGpu } from "./webgpu.js";
import { openWebGl2 } from "./webgl2.js";
import { openPictures } from "./pictures.js";

const WAYS = [["webgpu", openWebGpu], ["webgl2", openWebGl2], ["pictures", openPictures]];

// The first way that this browser can go, or the one that is wished for. A browser without a GPU draws slower than the server, so
// it gets pictures unless something else is wished for, or unless it is `alone`: no server renders any.
export async function openRenderer(canvas, wish, alone) {
  const reasons = [];
  for (const [name, open] of WAYS) {
    if ((wish && wish !== name) || (alone && name === "pictures")) continue;
    try {
      return Object.assign(await open(canvas, alone || Boolean(wish)), { name, reasons });
    } catch (error) {
      reasons.push(`${name}: ${error.message}`);
    }
  }
  throw new Error(`this browser cannot show the scene (${reasons.join("; ")})`);
}
