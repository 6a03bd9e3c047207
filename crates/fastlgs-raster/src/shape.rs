//! How the kernels divide their work among invocations.

use serde::{Deserialize, Serialize};
use std::fmt::{Display, Formatter};
use std::str::FromStr;

/// How the kernels divide their work; `shaders/shared/lane.wgsl` and `chunks.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// Sixteen invocations an 8x8 tile, in workgroups of 32: two tiles.
    // Reports of earlier trainings name shapes of eight invocations, which are no more.
    #[serde(alias = "shared", alias = "subgroups")]
    Lanes32,
    /// The same in workgroups of 64.
    Lanes64,
    /// One invocation a tile: for software rasterisers, whose invocations are vector lanes.
    Wide,
}

impl FromStr for Shape {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|shape| shape.to_string() == name)
            .ok_or_else(|| format!("there are {}", Self::ALL.map(|s| s.to_string()).join(", ")))
    }
}

impl Display for Shape {
    fn fmt(&self, out: &mut Formatter<'_>) -> std::fmt::Result {
        out.write_str(match self {
            Self::Lanes32 => "lanes32",
            Self::Lanes64 => "lanes64",
            Self::Wide => "wide",
        })
    }
}

impl Shape {
    /// All there are: every adapter can run each of them.
    pub const ALL: [Self; 3] = [Self::Lanes32, Self::Lanes64, Self::Wide];

    /// Flag of the shaders' permutations.
    pub(crate) fn flag(self) -> Option<&'static str> {
        match self {
            Shape::Lanes32 => None,
            Shape::Lanes64 => Some("LANES64"),
            Shape::Wide => Some("WIDE"),
        }
    }

    /// Chunks in which `n` items are sorted and added up, and the workgroups that do it.
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

    /// Invocations that write the tiles of one Gaussian; `shaders/emit.wgsl`.
    pub fn writers(self) -> u32 {
        if self == Shape::Wide { 1 } else { 8 }
    }

    /// Pairs of the runs within which gradient slots are added up before they are gathered; `shaders/fold_slots.wgsl`. A software adapter has
    /// too few invocations to gain by it.
    pub fn fold(self) -> u32 {
        if self == Shape::Wide { 1 } else { 32 }
    }

    /// Workgroups that blend `tiles` tiles.
    pub fn groups(self, tiles: u32) -> u32 {
        tiles.div_ceil(match self {
            Shape::Lanes32 => 2,
            Shape::Lanes64 => 4,
            Shape::Wide => 8,
        })
    }
}
