// Moves each (key, value) to its sorted position for one digit. The sort is stable. On entry
// `histogram` holds exclusive prefix sums; the pass may overwrite it.
#import chunks
#import flat

@group(0) @binding(0) var<uniform> job: ChunkJob;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;

fn move_item(i: u32, key: u32, position: u32) {
    keys_out[position] = key;
    values_out[position] = select(values[i], i, job.first == 1u);
}

#ifdef WIDE
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let chunk = chunk_of(id.x, job);
    for (var i = chunk.start; i < chunk.end; i++) {
        let key = keys[i];
        let slot = digit_of(key, job) * job.chunks + chunk.plane_index;
        let position = histogram[slot];
        histogram[slot] = position + 1u;
        move_item(i, key, position);
    }
}
#else
// Position of the next key of each digit.
var<workgroup> next_position: array<u32, 256>;
// Bit mask of 256 bits for each digit: the invocations that hold a key with it.
var<workgroup> holders: array<atomic<u32>, 2048>;

// Each round moves 256 keys, one for each invocation. A key's rank within its digit is the number
// of earlier invocations that hold the same digit.
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let chunk = chunk_of(flat_group(group, groups), job);
    if chunk.plane_index >= job.chunks {
        return;
    }
    next_position[lane] = histogram[lane * job.chunks + chunk.plane_index];
    for (var word = 0u; word < 8u; word++) {
        atomicStore(&holders[8u * lane + word], 0u);
    }
    let own_word = lane / 32u;
    let own_bit = 1u << (lane % 32u);
    for (var start = chunk.start; start < chunk.end; start += 256u) {
        workgroupBarrier();
        let i = start + lane;
        let holds = i < chunk.end;
        var key = 0u;
        if holds {
            key = keys[i];
            atomicOr(&holders[8u * digit_of(key, job) + own_word], own_bit);
        }
        workgroupBarrier();
        let digit = digit_of(key, job);
        var before = 0u;
        var digit_count = 0u;
        for (var word = 0u; word < 8u; word++) {
            let bits = atomicLoad(&holders[8u * digit + word]);
            before += countOneBits(select(select(0u, bits & (own_bit - 1u), word == own_word), bits, word < own_word));
            digit_count += countOneBits(bits);
        }
        if holds {
            move_item(i, key, next_position[digit] + before);
        }
        workgroupBarrier();
        // The last invocation of a digit prepares the next round.
        if holds && before + 1u == digit_count {
            next_position[digit] += digit_count;
            for (var word = 0u; word < 8u; word++) {
                atomicStore(&holders[8u * digit + word], 0u);
            }
        }
    }
}
#endif
