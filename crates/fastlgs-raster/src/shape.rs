//! How the blending kernels divide a tile among invocations.

use serde::{Deserialize, Serialize};

/// How the blending kernels divide an 8x8 tile; `shaders/shared/lane.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// Eight invocations a tile, which add up their gradients in shared memory.
    Shared,
    /// The same with subgroup operations.
    Subgroups,
    /// One invocation a tile: for software rasterisers, whose invocations are vector lanes.
    Wide,
}

impl Shape {
    /// Flag of the shaders' permutations.
    pub(crate) fn flag(self) -> Option<&'static str> {
        match self {
            Shape::Shared => None,
            Shape::Subgroups => Some("SUBGROUPS"),
            Shape::Wide => Some("WIDE"),
        }
    }

    /// Workgroups that blend `tiles` tiles.
    pub fn groups(self, tiles: u32) -> u32 {
        if self == Shape::Wide { tiles.div_ceil(8) } else { tiles }
    }
}
