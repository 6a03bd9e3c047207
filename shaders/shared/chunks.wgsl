// Serial chunks: invocation t of CHUNKS owns a contiguous part of n items. Stable, free of atomics and barriers,
// and what eight-lane software devices do best.
const CHUNKS: u32 = 256u;

struct Job {
    // Number of items.
    n: u32,
    // Bits that a radix digit is shifted by.
    shift: u32,
    // 1: values are made up as 0, 1, 2, ... instead of read.
    first: u32,
    unused: u32,
}

fn chunk_length(n: u32) -> u32 {
    return (n + CHUNKS - 1u) / CHUNKS;
}

// A sum beyond 32 bits stays at the largest value, which the host takes for "too many".
fn saturating(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, b > 0xffffffffu - a);
}
