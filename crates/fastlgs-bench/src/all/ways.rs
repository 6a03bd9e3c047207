//! The ways of making a scene, or of changing one, that `fastlgs-bench all` measures.

use crate::disturb::{MaskChange, PhotoChange};

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
    /// The first two given scenes with photos.
    TwoPhotographed,
    /// The same with the first seed alone: 30,000 iterations take most of an hour.
    TwoPhotographedOnce,
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
            _ => BASE,
        }
    }

    /// Name of the way whose answers to texts this one is compared with. The detector of everyday
    /// classes is part of neither the paper nor other fields, so ways without it are compared with
    /// its absence.
    pub fn text_reference(&self) -> &'static str {
        let has_detector = match self.how {
            How::Remap(_) => false,
            How::Baseline(method) => method.starts_with("code"),
            How::Train(options) => !options.contains(&"like-paper"),
            _ => true,
        };
        if has_detector {
            self.reference()
        } else {
            UNDETECTED
        }
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

/// The field without objects that the paper compares its grid with.
pub const MEAN_EMBEDDINGS: &str = "mean embeddings without a grid";

/// Training without the automatic limit of the number of Gaussians.
pub const UNLIMITED: &str = "no limit of Gaussians";

const fn way(
    pages: &'static [Page],
    name: &'static str,
    about: &'static str,
    on: On,
    how: How,
) -> Way {
    Way {
        pages,
        name,
        about,
        on,
        how,
    }
}

/// All ways, in the order in which they are measured.
pub const WAYS: &[Way] = {
    use How::{
        Baseline, Compact, Degree, Embeddings, Format, Kept, Make, Masks, Photos, Remap, Train,
        WithoutDetector,
    };
    use On::{Difficult, Given, TwoPhotographed, TwoPhotographedOnce};
    use Page::{Paper, Size, Speed, Stability};
    &[
        way(
            &[Speed, Stability, Size, Paper],
            BASE,
            "the default of `fastlgs make`; photos of at most 480 pixels a side",
            Given,
            Make(&[]),
        ),
        way(
            &[Stability],
            "as it is",
            "*quick* on a scene that is generated to be difficult",
            Difficult,
            Make(&[]),
        ),
        way(
            &[Paper],
            UNDETECTED,
            "objects are named by their embeddings alone; all other ways of the paper lack the detector too, but *code of 3 numbers*",
            Given,
            WithoutDetector,
        ),
        way(
            &[Paper, Speed],
            "paper's mapping",
            "`train --mapping paper`: Algorithm 1 finds the objects by embeddings, key points and colours",
            Given,
            Remap(&["--mapping", "paper"]),
        ),
        way(
            &[Paper],
            "paper's mapping by embeddings and key points",
            "Algorithm 1 without colours",
            Given,
            Remap(&["--mapping", "paper", "--cues", "keypoints"]),
        ),
        way(
            &[Paper],
            "paper's mapping by embeddings",
            "Algorithm 1 without colours and key points",
            Given,
            Remap(&["--mapping", "paper", "--cues", "none"]),
        ),
        way(
            &[Paper, Speed],
            MEAN_EMBEDDINGS,
            "each Gaussian has the mean embedding of its masks; each pixel is classified alone",
            Given,
            Baseline("raw"),
        ),
        way(
            &[Paper, Size],
            "code of 3 numbers",
            "each Gaussian has the code of its smallest object, of 3 numbers; a pixel belongs to the object with the nearest code",
            Given,
            Baseline("code3"),
        ),
        way(
            &[Size],
            "compact",
            "`export SCENE FOLDER`: a scene folder with compressed Gaussians",
            Given,
            Compact,
        ),
        way(
            &[Size],
            "SPZ",
            "Gaussians of `export SCENE FILE.spz`; the objects are mapped again",
            Given,
            Format("spz"),
        ),
        way(
            &[Size],
            "SOG",
            "Gaussians of `export SCENE FILE.sog`; the objects are mapped again",
            Given,
            Format("sog"),
        ),
        way(
            &[Size],
            "half of the Gaussians",
            "those that change the training views most, without further training",
            Given,
            Kept(0.5),
        ),
        way(
            &[Size],
            "a quarter of the Gaussians",
            "the same with a quarter",
            Given,
            Kept(0.25),
        ),
        way(
            &[Size],
            "SH degree 0",
            "colours without their dependence on the direction, without further training",
            Given,
            Degree(0),
        ),
        way(
            &[Stability],
            UNCHANGED,
            "*quick* from the prepared photos; the reference of all changed photos",
            TwoPhotographed,
            Photos(PhotoChange::Unchanged),
        ),
        way(
            &[Stability, Speed],
            "half of the photos missing",
            "a random half of the training photos is removed",
            TwoPhotographed,
            Photos(PhotoChange::Missing(0.5)),
        ),
        way(
            &[Stability],
            "blur 2 px",
            "each training photo is blurred by a Gaussian of 2 pixels",
            TwoPhotographed,
            Photos(PhotoChange::Blur(2.0)),
        ),
        way(
            &[Stability],
            "exposure 1 stop",
            "values of each training photo are multiplied by another factor, clipped at white: standard deviation 1 stop",
            TwoPhotographed,
            Photos(PhotoChange::Exposure(1.0)),
        ),
        way(
            &[Stability],
            "pose noise 4 px",
            "each training camera is turned by a random angle, 4 pixels in the mean",
            TwoPhotographed,
            Photos(PhotoChange::Pose(4.0)),
        ),
        way(
            &[Stability],
            "focal length 10 % too long",
            "the stated focal length of all training photos",
            TwoPhotographed,
            Photos(PhotoChange::Focal(0.1)),
        ),
        way(
            &[Stability],
            "white balance 20 %",
            "red and blue of each training photo are multiplied by other factors: standard deviation 20 %",
            TwoPhotographed,
            Photos(PhotoChange::WhiteBalance(0.2)),
        ),
        way(
            &[Stability],
            "JPEG quality 15",
            "each training photo is compressed",
            TwoPhotographed,
            Photos(PhotoChange::Jpeg(15)),
        ),
        way(
            &[Stability],
            "photos in random order",
            "the training photos are renamed",
            TwoPhotographed,
            Photos(PhotoChange::Shuffled),
        ),
        way(
            &[Stability, Speed],
            "three quarters of the photos missing",
            "a random quarter of the training photos stays",
            TwoPhotographed,
            Photos(PhotoChange::Missing(0.75)),
        ),
        way(
            &[Stability],
            "masks of whole objects only",
            "`preprocess --levels whole`: no masks of parts",
            TwoPhotographed,
            Make(&["--levels", "whole"]),
        ),
        way(
            &[Stability],
            "40 % of the masks split",
            "a random line through the centre splits each of them",
            Given,
            Masks(MaskChange::Split(0.4)),
        ),
        way(
            &[Stability],
            "40 % of the masks merged",
            "each of them is merged with a random neighbour",
            Given,
            Masks(MaskChange::Merged(0.4)),
        ),
        way(
            &[Stability],
            "40 % of the masks missing",
            "a random choice in each photo",
            Given,
            Masks(MaskChange::Dropped(0.4)),
        ),
        way(
            &[Stability],
            "masks eroded by 2 px",
            "each mask loses its border",
            Given,
            Masks(MaskChange::Eroded(2)),
        ),
        way(
            &[Stability],
            "noise of half an embedding's length",
            "random vectors are added to the embeddings of all objects; votes of the detector stay",
            Given,
            Embeddings(0.5),
        ),
        way(
            &[Speed, Size],
            "at most 10000 Gaussians",
            "`train --preset quick --budget 10000`",
            Given,
            Train(&["--preset", "quick", "--budget", "10000"]),
        ),
        way(
            &[Speed],
            "side 240",
            "photos of at most 240 pixels a side",
            TwoPhotographed,
            Make(&["--max-side", "240"]),
        ),
        way(
            &[Speed],
            "standard",
            "`train --preset standard`",
            Given,
            Train(&["--preset", "standard"]),
        ),
        way(
            &[Size, Speed],
            UNLIMITED,
            "`train --preset quick --budget 1000000`; no scene needs as many, so nothing limits them",
            Given,
            Train(&["--preset", "quick", "--budget", "1000000"]),
        ),
        way(
            &[Speed],
            "side 720",
            "photos of at most 720 pixels a side",
            TwoPhotographed,
            Make(&["--max-side", "720"]),
        ),
        way(
            &[Paper, Speed],
            "like LangSplat",
            "each Gaussian has two embeddings, of whole and of part masks, compressed to three numbers by a scene-wise autoencoder; each pixel is classified alone",
            Given,
            Baseline("langsplat"),
        ),
        way(
            &[Paper, Speed],
            "like LERF",
            "each Gaussian has embeddings of photo tiles at three scales; each pixel is classified alone",
            Given,
            Baseline("lerf"),
        ),
        way(
            &[Size],
            "code of 1 number",
            "a code of 1 number instead",
            Given,
            Baseline("code1"),
        ),
        way(
            &[Size],
            "code of 2 numbers",
            "a code of 2 numbers instead",
            Given,
            Baseline("code2"),
        ),
        way(
            &[Size],
            "code of 4 numbers",
            "a code of 4 numbers instead",
            Given,
            Baseline("code4"),
        ),
        way(
            &[Size],
            "code with an axis for each object",
            "such codes do not mix; what they lose are the larger objects at each pixel",
            Given,
            Baseline("codes"),
        ),
        way(
            &[Paper],
            "paper: theta 0.98",
            "Algorithm 1 with another least similarity of embeddings, instead of 0.7",
            Given,
            Remap(&["--mapping", "paper", "--theta", "0.98"]),
        ),
        way(
            &[Paper],
            "paper: tau 30",
            "Algorithm 1 with another least number of key points, instead of 4",
            Given,
            Remap(&["--mapping", "paper", "--tau", "30"]),
        ),
        way(
            &[Paper],
            "paper: alpha 0.05",
            "Algorithm 1 with another weight of colours, instead of 0.3",
            Given,
            Remap(&["--mapping", "paper", "--alpha", "0.05"]),
        ),
        way(
            &[Paper, Speed],
            "preset like-paper",
            "`train --preset like-paper`: Algorithm 1, and codes trained with the colours for 30,000 iterations",
            TwoPhotographedOnce,
            Train(&["--preset", "like-paper"]),
        ),
        way(
            &[Speed],
            "preset paper",
            "`train --preset paper`: 30,000 iterations of our own training and mapping",
            TwoPhotographedOnce,
            Train(&["--preset", "paper"]),
        ),
    ]
};

/// Returns the ways of a page.
pub fn on(page: Page) -> impl Iterator<Item = &'static Way> {
    WAYS.iter().filter(move |way| way.pages.contains(&page))
}
