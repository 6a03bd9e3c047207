// n items in contiguous chunks of like length, each of which is counted, added up or moved in order: so sorting is stable.
//
// A software rasteriser runs invocations as vector lanes, for which atomics and barriers are dear: there (WIDE) an invocation owns a chunk, and
// goes through it item by item. On real GPUs a workgroup of 256 shares a chunk, which then has at most 2,048 items.
struct Job {
    // Number of items.
    n: u32,
    // Bits that a radix digit is shifted by.
    shift: u32,
    // 1: values are made up as 0, 1, 2, ... instead of read.
    first: u32,
    // Number of chunks; the last may be shorter, or empty.
    chunks: u32,
}

struct Chunk {
    number: u32,
    // Its first item, and the one after its last.
    start: u32,
    end: u32,
}

fn chunk_of(number: u32, job: Job) -> Chunk {
    let length = (job.n + job.chunks - 1u) / job.chunks;
    return Chunk(number, min(job.n, number * length), min(job.n, (number + 1u) * length));
}

fn digit_of(key: u32, job: Job) -> u32 {
    return (key >> job.shift) & 255u;
}

// A sum beyond 32 bits stays at the largest value, which the host takes for "too many".
fn saturating(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, b > 0xffffffffu - a);
}
