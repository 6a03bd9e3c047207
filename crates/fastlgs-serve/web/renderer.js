// Choice of the renderer.

import { openWebGpu } from "./webgpu.js";
import { openWebGl2 } from "./webgl2.js";
import { openPictures } from "./pictures.js";

const RENDERERS = [["webgpu", openWebGpu], ["webgl2", openWebGl2], ["pictures", openPictures]];

// Opens the renderer named `wish`, or the first that works in this browser.
//
// Without a GPU, the server renders faster than the browser. The page then shows pictures of the
// server, unless `wish` names another renderer. `alone`: there is no server that can render.
export async function openRenderer(canvas, wish, alone) {
  const reasons = [];
  for (const [name, open] of RENDERERS) {
    if ((wish && wish !== name) || (alone && name === "pictures")) continue;
    try {
      return Object.assign(await open(canvas, alone || Boolean(wish)), { name, reasons });
    } catch (error) {
      reasons.push(`${name}: ${error.message}`);
    }
  }
  throw new Error(`this browser cannot show the scene (${reasons.join("; ")})`);
}
