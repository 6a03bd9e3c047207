// Dispatches above 65,535 workgroups are split over y: this is the workgroup's number in one line.
fn flat_group(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.x + group.y * groups.x;
}
