//! How the blending kernels divide a tile among invocations.

use serde::{Deserialize, Serialize};
use std::fmt::{Display, Formatter};
use std::str::FromStr;

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

impl FromStr for Shape {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let all = [Self::Shared, Self::Subgroups, Self::Wide];
        all.into_iter()
            .find(|shape| shape.to_string() == name)
            .ok_or_else(|| format!("there are {}", all.map(|s| s.to_string()).join(", ")))
    }
}

impl Display for Shape {
    fn fmt(&self, out: &mut Formatter<'_>) -> std::fmt::Result {
        out.write_str(match self {
            Self::Shared => "shared",
            Self::Subgroups => "subgroups",
            Self::Wide => "wide",
        })
    }
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

    /// Chunks in which `n` items are sorted and added up, and the workgroups that do it; `shaders/shared/chunks.wgsl`.
    pub fn chunks(self, n: u32) -> (u32, u32) {
        // An invocation of a software adapter owns a chunk: enough of them for its threads, few enough to add up their totals.
        const SERIAL: u32 = 256;
        const SHARED: u32 = 2048;
        if self == Shape::Wide {
            return (SERIAL, SERIAL / 64);
        }
        let chunks = n.div_ceil(SHARED).max(1);
        (chunks, chunks)
    }

    /// Workgroups that blend `tiles` tiles.
    pub fn groups(self, tiles: u32) -> u32 {
        if self == Shape::Wide { tiles.div_ceil(8) } else { tiles }
    }
}
