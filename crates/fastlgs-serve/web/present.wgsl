// Copies the blended picture to the canvas. Gaussians are blended in 16-bit floats: in the eight bits of a canvas, colours above
// one would be cut off before what lies in front of them is blended, and small shares would be lost.

@group(0) @binding(0) var picture: texture_2d<f32>;

@vertex
fn corner(@builtin(vertex_index) number: u32) -> @builtin(position) vec4<f32> {
    // One triangle that covers everything.
    return vec4<f32>(f32(number & 1u) * 4.0 - 1.0, f32(number >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn pixel(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    return vec4<f32>(textureLoad(picture, vec2<i32>(position.xy), 0).rgb, 1.0);
}
