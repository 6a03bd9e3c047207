//! The ways of making a scene, or of changing one, that `fastlgs-bench all` measures.

mod list;

use crate::disturb::{MaskChange, PhotoChange};
pub use list::WAYS;

/// A page of the results.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Page {
    Speed,
    Stability,
    Size,
    Paper,
}

/// Scenes that a way is measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum On {
    /// All given scenes. Those without labels have only the ways of [`Page::Size`].
    Given,
    /// The first given scenes with photos and labels: this number of them.
    Photographed(usize),
    /// The first given scenes with labels: this number of them, with the first seed alone, because
    /// 30,000 iterations take from a quarter of an hour to a whole one.
    LabelledOnce(usize),
    /// Scenes generated to be difficult, which need not be given.
    Difficult,
}

/// How a row is made. All but the first two change the scene of [`BASE`] with the same seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum How {
    /// `preprocess` and `train`, with these further options of `preprocess`.
    Make(&'static [&'static str]),
    /// The same from changed photos of training. Held-out views without labels are left out.
    Photos(PhotoChange),
    /// `train` with these options, on the prepared scene.
    Train(&'static [&'static str]),
    /// `train` with these options, on the trained Gaussians, which stay.
    Remap(&'static [&'static str]),
    /// Changed masks, mapped to the trained Gaussians.
    Masks(MaskChange),
    /// Noise on the objects' embeddings, with this root mean square length.
    Embeddings(f32),
    /// Objects without the detector's votes.
    WithoutDetector,
    /// Another language field on the same Gaussians: `fastlgs-bench baseline --method`.
    Baseline(&'static str),
    /// Gaussians exported to a file of this format, and mapped again.
    Format(&'static str),
    /// The exported compact scene folder.
    Compact,
    /// Gaussians with this SH degree.
    Degree(u32),
    /// This share of the Gaussians: those that change the photos most.
    Kept(f64),
}

/// A way of making a scene.
pub struct Way {
    /// Pages that have it.
    pub pages: &'static [Page],
    pub name: &'static str,
    /// What exactly is done, for readers of the pages.
    pub about: &'static str,
    pub on: On,
    pub how: How,
}

impl Way {
    /// Name of the way whose rows this one is compared with.
    pub fn reference(&self) -> &'static str {
        match self.how {
            How::Photos(change) if change != PhotoChange::Unchanged => UNCHANGED,
            How::Remap(_) if self.name != PAPER_MAPPING => PAPER_MAPPING,
            _ => BASE,
        }
    }

    /// Name of the way whose answers to texts this one is compared with. The detector of everyday
    /// classes is part of neither the paper nor other fields, so ways without it are compared with
    /// one that lacks it too.
    pub fn text_reference(&self) -> &'static str {
        match self.reference() {
            BASE if !self.has_detector() && self.name != UNDETECTED => UNDETECTED,
            reference => reference,
        }
    }

    /// Whether objects have votes of the detector of everyday classes.
    pub fn has_detector(&self) -> bool {
        match self.how {
            How::Remap(_) | How::WithoutDetector => false,
            How::Baseline(method) => method.starts_with("code"),
            How::Train(options) => !options.contains(&"like-paper"),
            _ => true,
        }
    }

    /// Whether it starts from prepared photos, so that its seconds lack any repair of poses.
    pub fn starts_prepared(&self) -> bool {
        matches!(self.how, How::Photos(_))
    }

    /// Whether its photos have another size, so that their PSNR is that of other pixels.
    pub fn has_other_pixels(&self) -> bool {
        matches!(self.how, How::Make(options) if options.contains(&"--max-side"))
    }

    /// Whether it is measured on scenes without labels too.
    pub fn needs_no_labels(&self) -> bool {
        self.pages.contains(&Page::Size) && !matches!(self.how, How::Baseline(_))
    }
}

/// The default way: preset quick. It is on all pages, and most ways start from its scene.
pub const BASE: &str = "quick";
/// The reference of changed photos.
pub const UNCHANGED: &str = "photos as they are";

/// The default way without the detector of everyday classes.
pub const UNDETECTED: &str = "quick without the detector";

/// Objects by Algorithm 1 of the paper.
pub const PAPER_MAPPING: &str = "paper's mapping";

/// The field without objects that the paper compares its grid with.
pub const MEAN_EMBEDDINGS: &str = "mean embeddings without a grid";

/// Training without the automatic limit of the number of Gaussians.
pub const UNLIMITED: &str = "no limit of Gaussians";

/// Returns the ways of a page.
pub fn on(page: Page) -> impl Iterator<Item = &'static Way> {
    WAYS.iter().filter(move |way| way.pages.contains(&page))
}
