// Sums over a workgroup of 256 invocations.
#import chunks

// Two halves: one is read while the other is written.
var<workgroup> prefix_sums: array<u32, 512>;

// Writes the sum of the values of the first k + 1 invocations to prefix_sums[k] (Hillis & Steele
// 1986).
fn inclusive_scan(value: u32, lane: u32) {
    var side = 0u;
    prefix_sums[lane] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < 256u; reach *= 2u) {
        var sum = prefix_sums[side + lane];
        if lane >= reach {
            sum = saturating(prefix_sums[side + lane - reach], sum);
        }
        side = 256u - side;
        prefix_sums[side + lane] = sum;
        workgroupBarrier();
    }
}

// Returns the sum of the values of all invocations.
fn group_sum(value: u32, lane: u32) -> u32 {
    inclusive_scan(value, lane);
    let all = prefix_sums[255];
    workgroupBarrier();
    return all;
}
