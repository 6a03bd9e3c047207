// Measures how much the pixels of a tile change without each of its Gaussians: the sum of
// (factor x d)^2 over pixels and colours, with
//     d = alpha / (1 - alpha) x (colour behind) - alpha x transmittance x (own colour).
// The sum corresponds to the diagonal of the Hessian in Optimal Brain Damage (LeCun et al. 1990).
//
// frame    [8][tile rows * 8][tile columns * 8]: the blended frame; its colours are read
// factors  [3][tile rows * 8][tile columns * 8]: factor on the changes of each colour
// saliency [pair in sorted order]: the sums; 0 at first
#import view
#import flat
#import quad
#import tile_part

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> factors: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> saliency: array<f32>;

struct Quad {
    transmittance: vec4<f32>,
    // Colour behind the Gaussians processed so far, including the background.
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
}

struct Factors {
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
}

fn squared_change(quad: ptr<function, Quad>, factor: Factors, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) -> vec4<f32> {
    let t = (*quad).transmittance;
    let alpha = alphas(dx, s0.z, row_of(s0, s1, dy));
    let w = t * alpha;
    (*quad).transmittance = t - w;
    (*quad).r -= w * s1.z;
    (*quad).g -= w * s1.w;
    (*quad).b -= w * s2.x;
    let more = alpha / (1.0 - alpha);
    let r = factor.r * (more * (*quad).r - w * s1.z);
    let g = factor.g * (more * (*quad).g - w * s1.w);
    let b = factor.b * (more * (*quad).b - w * s2.x);
    return r * r + g * g + b * b;
}

var<workgroup> max_length: atomic<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    let own = tile_part_of(flat_group(group, groups), index);
    if index == 0u {
        atomicStore(&max_length, 0u);
    }
    workgroupBarrier();
    atomicMax(&max_length, own.length);
    let longest = workgroupUniformLoad(&max_length);

    let px = vec4<f32>(f32(own.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(own.y) + 0.5;
#each K 2
    var q$K: Quad;
    var factor$K: Factors;
    q$K.transmittance = inside(own.x, own.y + $Ku, view);
    if own.length > 0u {
        q$K.r = frame[quad_at(0u, own.x, own.y + $Ku, view)];
        q$K.g = frame[quad_at(1u, own.x, own.y + $Ku, view)];
        q$K.b = frame[quad_at(2u, own.x, own.y + $Ku, view)];
        factor$K.r = factors[quad_at(0u, own.x, own.y + $Ku, view)];
        factor$K.g = factors[quad_at(1u, own.x, own.y + $Ku, view)];
        factor$K.b = factors[quad_at(2u, own.x, own.y + $Ku, view)];
    }
#end
    var unfinished = own.length > 0u;
    for (var k = 0u; k < longest; k += BATCH) {
        if index == 0u {
            atomicStore(&unfinished_tiles, 0u);
        }
        workgroupBarrier();
#each K 8
        var squares$K = vec4<f32>(0.0);
        if unfinished && k + $Ku < own.length {
            let i = 3u * pair_gaussians[sorted_pairs[own.start + k + $Ku]];
            let s0 = splats[i];
            let s1 = splats[i + 1u];
            let s2 = splats[i + 2u];
            squares$K = squared_change(&q0, factor0, px - s0.x, py - s0.y, s0, s1, s2) + squared_change(&q1, factor1, px - s0.x, py + 1.0 - s0.y, s0, s1, s2);
        }
        put_partial(own, $Ku, squares$K);
#end
        workgroupBarrier();
        if k + own.lane < own.length {
            saliency[own.start + k + own.lane] = tile_sum(own);
        }
        if k + BATCH < own.length {
            mark_unfinished(own, max(q0.transmittance, q1.transmittance));
        }
        let still_open = workgroupUniformLoad(&unfinished_tiles);
        if still_open == 0u {
            break;
        }
        unfinished = (still_open & (1u << own.slot)) != 0u;
    }
}
