// Returns the linear index of a workgroup. Dispatches of more than 65,535 workgroups are split over
// y.
fn flat_group(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.x + group.y * groups.x;
}
