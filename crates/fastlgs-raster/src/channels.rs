//! The channels that a step renders and trains.

/// What a step renders and trains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
pub enum Channels {
    /// Geometry and colour.
    Color,
    /// The feature only; geometry is frozen.
    Feature,
    /// Geometry, colour and feature. The feature loss does not move geometry.
    Both,
    /// Geometry, colour and feature. The feature loss moves geometry too.
    Coupled,
}

impl Channels {
    /// Returns whether geometry and colour are included.
    pub fn color(self) -> bool {
        self != Self::Feature
    }

    /// Returns whether the feature is included.
    pub fn feature(self) -> bool {
        self != Self::Color
    }

    /// Returns the number of four-float groups in a gradient slot.
    pub(crate) fn slot(self) -> usize {
        if self.color() { 3 } else { 1 }
    }

    /// Returns the flags of the shader permutation.
    pub(crate) fn flags(self) -> &'static [&'static str] {
        match self {
            Self::Color => &["WITH_COLOR"],
            Self::Feature => &["WITH_FEATURE"],
            Self::Both => &["WITH_COLOR", "WITH_FEATURE"],
            Self::Coupled => &["WITH_COLOR", "WITH_FEATURE", "FEATURE_MOVES"],
        }
    }
}
