// WebGPU renderer.

import { OBJECT_ROWS, ROW, packFrame } from "./frame.js";

export async function openWebGpu(canvas, evenSlow) {
  const adapter = await navigator.gpu?.requestAdapter();
  if (!adapter) throw new Error("no WebGPU adapter");
  if (adapter.info.isFallbackAdapter && !evenSlow) throw new Error("only a software adapter");
  // Requests the largest textures: their width is fixed, so large scenes need many rows.
  const { maxTextureDimension2D } = adapter.limits;
  const device = await adapter.requestDevice({ requiredLimits: { maxTextureDimension2D } });
  const format = navigator.gpu.getPreferredCanvasFormat();
  const shader = async (path) => device.createShaderModule({ code: await (await fetch(path)).text() });
  const [module, present] = await Promise.all([shader("splat.wgsl"), shader("present.wgsl")]);
  const layout = device.createBindGroupLayout({
    entries: [
      { binding: 0, visibility: GPUShaderStage.VERTEX | GPUShaderStage.FRAGMENT, buffer: {} },
      { binding: 1, visibility: GPUShaderStage.VERTEX, texture: { sampleType: "uint" } },
      { binding: 2, visibility: GPUShaderStage.VERTEX, texture: { sampleType: "unfilterable-float" } },
    ],
  });
  const over = { srcFactor: "one", dstFactor: "one-minus-src-alpha", operation: "add" };
  const pipeline = (target) => device.createRenderPipelineAsync({
    layout: device.createPipelineLayout({ bindGroupLayouts: [layout] }),
    vertex: {
      module, entryPoint: "corner",
      buffers: [{ arrayStride: 4, stepMode: "instance", attributes: [{ shaderLocation: 0, offset: 0, format: "uint32" }] }],
    },
    fragment: { module, entryPoint: "pixel", targets: [target] },
    primitive: { topology: "triangle-strip" },
  });
  const [blending, picking, presenting] = await Promise.all([
    pipeline({ format: "rgba16float", blend: { color: over, alpha: over } }),
    pipeline({ format: "rgba8unorm" }),
    device.createRenderPipelineAsync({ layout: "auto", vertex: { module: present }, fragment: { module: present, targets: [{ format }] } }),
  ]);
  // Only after success: a canvas with a WebGPU context cannot get another context.
  const context = canvas.getContext("webgpu");
  context.configure({ device, format, alphaMode: "opaque" });

  const texture = (kind, height, width) => device.createTexture({
    size: [width, height], format: kind, usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST,
  });
  const uniform = device.createBuffer({ size: 128, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
  const states = texture("rgba8unorm", OBJECT_ROWS, 256);
  let splatTexture, order, orderLength = 0, group, splats, picture, shown;

  // Resizes the float texture of the picture to the canvas.
  function resize({ width, height }) {
    if (picture?.width === width && picture.height === height) return;
    picture?.destroy();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
    picture = device.createTexture({ size: [width, height], format: "rgba16float", usage });
    shown = device.createBindGroup({ layout: presenting.getBindGroupLayout(0), entries: [{ binding: 0, resource: picture.createView() }] });
  }

  function pass(encoder, view, color, pipeline) {
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, clearValue: color, loadOp: "clear", storeOp: "store" }] });
    if (orderLength > 0) {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, group);
      pass.setVertexBuffer(0, order);
      pass.draw(4, orderLength);
    }
    pass.end();
  }

  return {
    lost: device.lost,
    setSplats(next) {
      if (next.rows > device.limits.maxTextureDimension2D) throw new Error("the scene is too large for this browser's textures");
      splats = next;
      splatTexture?.destroy();
      order?.destroy();
      splatTexture = texture("rgba32uint", splats.rows, ROW);
      device.queue.writeTexture({ texture: splatTexture }, splats.data, { bytesPerRow: ROW * 16 }, [ROW, splats.rows]);
      order = device.createBuffer({ size: Math.max(4, 4 * splats.count), usage: GPUBufferUsage.VERTEX | GPUBufferUsage.COPY_DST });
      orderLength = 0;
      group = device.createBindGroup({
        layout,
        entries: [{ binding: 0, resource: { buffer: uniform } }, { binding: 1, resource: splatTexture.createView() }, { binding: 2, resource: states.createView() }],
      });
    },
    setObjects(bytes) {
      device.queue.writeTexture({ texture: states }, bytes, { bytesPerRow: 1024 }, [256, OBJECT_ROWS]);
    },
    setOrder(next) {
      device.queue.writeBuffer(order, 0, next);
      orderLength = next.length;
    },
    draw(frame) {
      device.queue.writeBuffer(uniform, 0, packFrame({ ...frame, splats }));
      const [r, g, b] = frame.mode === "objects" ? [0, 0, 0] : frame.scene.background;
      resize(frame);
      const encoder = device.createCommandEncoder();
      pass(encoder, picture.createView(), { r, g, b, a: 1 }, blending);
      const last = encoder.beginRenderPass({
        colorAttachments: [{ view: context.getCurrentTexture().createView(), loadOp: "clear", storeOp: "store" }],
      });
      last.setPipeline(presenting);
      last.setBindGroup(0, shown);
      last.draw(3);
      last.end();
      device.queue.submit([encoder.finish()]);
    },
    // Returns the Gaussian id at a pixel of the canvas; it identifies the objects there.
    async pick(frame, x, y) {
      device.queue.writeBuffer(uniform, 0, packFrame({ ...frame, mode: "ids", splats }));
      const target = device.createTexture({
        size: [frame.width, frame.height], format: "rgba8unorm", usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC,
      });
      const read = device.createBuffer({ size: 256, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
      const encoder = device.createCommandEncoder();
      pass(encoder, target.createView(), { r: 0, g: 0, b: 0, a: 0 }, picking);
      encoder.copyTextureToBuffer({ texture: target, origin: [x, y] }, { buffer: read, bytesPerRow: 256 }, [1, 1]);
      device.queue.submit([encoder.finish()]);
      await read.mapAsync(GPUMapMode.READ);
      const [low, high] = new Uint8Array(read.getMappedRange());
      read.destroy();
      target.destroy();
      return low + 256 * high;
    },
  };
}
