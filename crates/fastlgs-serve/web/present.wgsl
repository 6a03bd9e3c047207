// Copies the blended picture to the canvas.
//
// Gaussians are blended in 16-bit floats. In the 8 bits of a canvas, colours above 1 would be
// clamped before nearer Gaussians are blended over them. Small contributions would be lost.

@group(0) @binding(0) var picture: texture_2d<f32>;

@vertex
fn corner(@builtin(vertex_index) plane_index: u32) -> @builtin(position) vec4<f32> {
    // One triangle that covers the canvas.
    return vec4<f32>(f32(plane_index & 1u) * 4.0 - 1.0, f32(plane_index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn pixel(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    return vec4<f32>(textureLoad(picture, vec2<i32>(position.xy), 0).rgb, 1.0);
}
