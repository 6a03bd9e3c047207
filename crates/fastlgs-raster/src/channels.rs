//! What a step renders and trains.

/// What a step renders and trains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
pub enum Channels {
    /// Geometry and colour.
    Color,
    /// The feature alone, geometry being frozen.
    Feature,
    /// Both; the feature does not move geometry.
    Both,
    /// Both, and the feature moves geometry too.
    Coupled,
}

impl Channels {
    /// Whether geometry and colour are among them.
    pub fn color(self) -> bool {
        self != Self::Feature
    }

    /// Whether the feature is among them.
    pub fn feature(self) -> bool {
        self != Self::Color
    }

    /// Groups of four floats in a gradient slot.
    pub(crate) fn slot(self) -> usize {
        if self.color() { 3 } else { 1 }
    }

    /// Flags of the shaders' permutations.
    pub(crate) fn flags(self) -> &'static [&'static str] {
        match self {
            Self::Color => &["WITH_COLOR"],
            Self::Feature => &["WITH_FEATURE"],
            Self::Both => &["WITH_COLOR", "WITH_FEATURE"],
            Self::Coupled => &["WITH_COLOR", "WITH_FEATURE", "FEATURE_MOVES"],
        }
    }
}
