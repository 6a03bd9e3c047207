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

    /// Returns whether a channel of a frame is included: colour is 0 to 2, the feature 3 to 5.
    pub(crate) fn includes(self, channel: usize) -> bool {
        match channel {
            0..3 => self.color(),
            3..6 => self.feature(),
            _ => false,
        }
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
