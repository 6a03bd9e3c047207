// Splits n items into contiguous chunks of equal length. Each chunk is processed in order, so that
// sorting is stable.
//
// A software adapter runs invocations as vector lanes and has slow atomics and barriers. There
// (WIDE) an invocation processes a chunk item by item. On real GPUs a workgroup of 256 shares a
// chunk of at most 2,048 items.
struct ChunkJob {
    // Number of items.
    n: u32,
    // Right shift in bits of the radix digit.
    shift: u32,
    // 1: the values are 0, 1, 2, ... and are not read.
    first: u32,
    // Number of chunks; the last may be shorter, or empty.
    chunks: u32,
}

struct Chunk {
    plane_index: u32,
    // First item and end (excluded).
    start: u32,
    end: u32,
}

fn chunk_of(plane_index: u32, job: ChunkJob) -> Chunk {
    let length = (job.n + job.chunks - 1u) / job.chunks;
    return Chunk(plane_index, min(job.n, plane_index * length), min(job.n, (plane_index + 1u) * length));
}

fn digit_of(key: u32, job: ChunkJob) -> u32 {
    return (key >> job.shift) & 255u;
}

// Returns a + b, saturated at 2^32 - 1, which the host reports as too many pairs.
fn saturating(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, b > 0xffffffffu - a);
}
