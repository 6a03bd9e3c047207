// WebGL2 renderer, with the shaders that the build translates from splat.wgsl. Names of uniforms
// are those of naga.

import { OBJECT_ROWS, ROW, packFrame } from "./frame.js";

// Returns whether WebGL2 runs without a GPU. Tests another canvas, because a canvas keeps its first
// context.
function isSlow() {
  const gl = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  return !gl || /swiftshader|llvmpipe|softpipe|software/i.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

export async function openWebGl2(canvas, evenSlow) {
  if (!evenSlow && isSlow()) throw new Error("only a software rasteriser");
  const sources = await Promise.all(["corner.glsl", "pixel.glsl"].map(async (path) => (await fetch(path)).text()));
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("no WebGL2");
  const program = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[k]);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  for (const block of ["Frame_block_0Vertex", "Frame_block_0Fragment"]) {
    const index = gl.getUniformBlockIndex(program, block);
    if (index !== gl.INVALID_INDEX) gl.uniformBlockBinding(program, index, 0);
  }
  gl.uniform1i(gl.getUniformLocation(program, "_group_0_binding_1_vs"), 0);
  gl.uniform1i(gl.getUniformLocation(program, "_group_0_binding_2_vs"), 1);

  const uniform = gl.createBuffer();
  gl.bindBuffer(gl.UNIFORM_BUFFER, uniform);
  gl.bufferData(gl.UNIFORM_BUFFER, 128, gl.DYNAMIC_DRAW);
  gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, uniform);
  const order = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  const texture = (unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  };
  texture(0);
  texture(1);
  // Blends in 16-bit floats if the browser has them; present.wgsl gives the reason.
  const floats = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
  const target = () => ({ buffer: gl.createRenderbuffer(), frame: gl.createFramebuffer() });
  const [ids, picture] = [target(), target()];
  function bind({ buffer, frame }, format, { width, height }) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, buffer);
  }
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  let orderLength = 0, splats;

  function pass(frame, color) {
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, packFrame({ ...frame, splats }));
    gl.viewport(0, 0, frame.width, frame.height);
    gl.clearColor(...color);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, orderLength);
  }

  return {
    lost: new Promise((lost) => canvas.addEventListener("webglcontextlost", lost)),
    setSplats(next) {
      if (next.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the scene is too large for this browser's textures");
      splats = next;
      orderLength = 0;
      gl.activeTexture(gl.TEXTURE0);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, ROW, splats.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, splats.data);
    },
    setObjects(bytes) {
      gl.activeTexture(gl.TEXTURE1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, OBJECT_ROWS, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    },
    setOrder(next) {
      gl.bufferData(gl.ARRAY_BUFFER, next, gl.DYNAMIC_DRAW);
      orderLength = next.length;
    },
    draw(frame) {
      if (floats) bind(picture, gl.RGBA16F, frame);
      gl.enable(gl.BLEND);
      pass(frame, frame.mode === "objects" ? [0, 0, 0, 1] : [...frame.scene.background, 1]);
      if (!floats) return;
      const all = [0, 0, frame.width, frame.height];
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
      gl.blitFramebuffer(...all, ...all, gl.COLOR_BUFFER_BIT, gl.NEAREST);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    },
    // Returns the Gaussian id at a pixel of the canvas; it identifies the objects there.
    async pick(frame, x, y) {
      bind(ids, gl.RGBA8, frame);
      gl.disable(gl.BLEND);
      pass({ ...frame, mode: "ids" }, [0, 0, 0, 0]);
      const pixel = new Uint8Array(4);
      gl.readPixels(x, frame.height - 1 - y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      return pixel[0] + 256 * pixel[1];
    },
  };
}
