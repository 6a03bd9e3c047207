//! The rows of `fastlgs-bench all`: each is a way of making a scene, or of changing one.

use crate::disturb::{MaskChange, PhotoChange};
use std::path::{Path, PathBuf};

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
    /// The same with seed 0 alone: 30,000 iterations take an hour.
    TwoPhotographedOnce,
    /// Scenes generated to be difficult, which need not be given.
    Difficult,
}

/// How a row is made. All but the first two change the scene of [`BASE`] with the same seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum How {
    /// `preprocess` and `train`, with these further options of `preprocess`.
    Make(&'static [&'static str]),
    /// The same from changed photos. Held-out views without labels are left out.
    Photos(PhotoChange),
    /// `train` with these options, on the prepared scene.
    Train(&'static [&'static str]),
    /// `train` with these options, on the trained Gaussians, which stay.
    Remap(&'static [&'static str]),
    /// Changed masks, mapped to the trained Gaussians.
    Masks(MaskChange),
    /// Noise on the objects' embeddings, with this root mean square length.
    Embeddings(f32),
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
    pub on: On,
    pub how: How,
}

impl Way {
    /// Name of the way whose rows this one is compared with.
    pub fn reference(&self) -> &'static str {
        match self.how {
            How::Photos(_) => UNCHANGED,
            How::Remap(_) if self.pages == [Page::Stability] => "paper's mapping",
            _ => BASE,
        }
    }

    /// Whether it is measured on scenes without labels too.
    fn needs_no_labels(&self) -> bool {
        self.pages.contains(&Page::Size) && !matches!(self.how, How::Baseline(_))
    }
}

/// The default way: preset quick. It is on all pages, and most ways start from its scene.
pub const BASE: &str = "quick";
/// Photos as they are: the reference of disturbed photos.
pub const UNCHANGED: &str = "photos as they are";

/// Training without the automatic limit of the number of Gaussians.
pub const UNLIMITED: &str = "no limit of Gaussians";

const fn way(pages: &'static [Page], name: &'static str, on: On, how: How) -> Way {
    Way {
        pages,
        name,
        on,
        how,
    }
}

/// All ways, in the order in which they are measured.
pub const WAYS: &[Way] = {
    use How::{
        Baseline, Compact, Degree, Embeddings, Format, Kept, Make, Masks, Photos, Remap, Train,
    };
    use On::{Difficult, Given, TwoPhotographed, TwoPhotographedOnce};
    use Page::{Paper, Size, Speed, Stability};
    &[
        way(&[Speed, Stability, Size, Paper], BASE, Given, Make(&[])),
        way(&[Stability], "as it is", Difficult, Make(&[])),
        way(
            &[Paper, Speed],
            "paper's mapping",
            Given,
            Remap(&["--mapping", "paper"]),
        ),
        way(
            &[Paper],
            "paper's mapping by embeddings and key points",
            Given,
            Remap(&["--mapping", "paper", "--cues", "keypoints"]),
        ),
        way(
            &[Paper],
            "paper's mapping by embeddings",
            Given,
            Remap(&["--mapping", "paper", "--cues", "none"]),
        ),
        way(
            &[Paper, Speed],
            "mean embeddings without a grid",
            Given,
            Baseline("raw"),
        ),
        way(
            &[Paper, Size],
            "code of 3 numbers",
            Given,
            Baseline("code3"),
        ),
        way(&[Size], "compact", Given, Compact),
        way(&[Size], "SPZ", Given, Format("spz")),
        way(&[Size], "SOG", Given, Format("sog")),
        way(&[Size], "half of the Gaussians", Given, Kept(0.5)),
        way(&[Size], "a quarter of the Gaussians", Given, Kept(0.25)),
        way(&[Size], "SH degree 0", Given, Degree(0)),
        way(
            &[Stability],
            UNCHANGED,
            TwoPhotographed,
            Photos(PhotoChange::Unchanged),
        ),
        way(
            &[Stability, Speed],
            "half of the photos missing",
            TwoPhotographed,
            Photos(PhotoChange::Missing(0.5)),
        ),
        way(
            &[Stability],
            "blur 2 px",
            TwoPhotographed,
            Photos(PhotoChange::Blur(2.0)),
        ),
        way(
            &[Stability],
            "exposure 1 stop",
            TwoPhotographed,
            Photos(PhotoChange::Exposure(1.0)),
        ),
        way(
            &[Stability],
            "pose noise 4 px",
            TwoPhotographed,
            Photos(PhotoChange::Pose(4.0)),
        ),
        way(
            &[Stability],
            "focal length 10 % too long",
            TwoPhotographed,
            Photos(PhotoChange::Focal(0.1)),
        ),
        way(
            &[Stability],
            "white balance 20 %",
            TwoPhotographed,
            Photos(PhotoChange::WhiteBalance(0.2)),
        ),
        way(
            &[Stability],
            "JPEG quality 15",
            TwoPhotographed,
            Photos(PhotoChange::Jpeg(15)),
        ),
        way(
            &[Stability],
            "photos in random order",
            TwoPhotographed,
            Photos(PhotoChange::Shuffled),
        ),
        way(
            &[Stability, Speed],
            "three quarters of the photos missing",
            TwoPhotographed,
            Photos(PhotoChange::Missing(0.75)),
        ),
        way(
            &[Stability],
            "masks of whole objects only",
            TwoPhotographed,
            Make(&["--levels", "whole"]),
        ),
        way(
            &[Stability],
            "40 % of the masks split",
            Given,
            Masks(MaskChange::Split(0.4)),
        ),
        way(
            &[Stability],
            "40 % of the masks merged",
            Given,
            Masks(MaskChange::Merged(0.4)),
        ),
        way(
            &[Stability],
            "40 % of the masks missing",
            Given,
            Masks(MaskChange::Dropped(0.4)),
        ),
        way(
            &[Stability],
            "masks eroded by 2 px",
            Given,
            Masks(MaskChange::Eroded(2)),
        ),
        way(
            &[Stability],
            "noise of half an embedding's length",
            Given,
            Embeddings(0.5),
        ),
        way(
            &[Speed, Size],
            "at most 10000 Gaussians",
            Given,
            Train(&["--preset", "quick", "--budget", "10000"]),
        ),
        way(
            &[Speed],
            "side 240",
            TwoPhotographed,
            Make(&["--max-side", "240"]),
        ),
        way(
            &[Speed],
            "standard",
            Given,
            Train(&["--preset", "standard"]),
        ),
        way(
            &[Size, Speed],
            UNLIMITED,
            Given,
            Train(&["--preset", "quick", "--budget", "1000000"]),
        ),
        way(
            &[Speed],
            "side 720",
            TwoPhotographed,
            Make(&["--max-side", "720"]),
        ),
        way(
            &[Paper, Speed],
            "like LangSplat",
            Given,
            Baseline("langsplat"),
        ),
        way(&[Paper, Speed], "like LERF", Given, Baseline("lerf")),
        way(&[Size], "code of 1 number", Given, Baseline("code1")),
        way(&[Size], "code of 2 numbers", Given, Baseline("code2")),
        way(&[Size], "code of 4 numbers", Given, Baseline("code4")),
        way(
            &[Stability],
            "paper: theta 0.98",
            Given,
            Remap(&["--mapping", "paper", "--theta", "0.98"]),
        ),
        way(
            &[Stability],
            "paper: tau 30",
            Given,
            Remap(&["--mapping", "paper", "--tau", "30"]),
        ),
        way(
            &[Stability],
            "paper: alpha 0.05",
            Given,
            Remap(&["--mapping", "paper", "--alpha", "0.05"]),
        ),
        way(
            &[Paper, Speed],
            "all as in the paper",
            TwoPhotographedOnce,
            Train(&["--preset", "like-paper"]),
        ),
        way(
            &[Speed],
            "paper",
            TwoPhotographedOnce,
            Train(&["--preset", "paper"]),
        ),
    ]
};

/// Returns the ways of a page.
pub fn on(page: Page) -> impl Iterator<Item = &'static Way> {
    WAYS.iter().filter(move |way| way.pages.contains(&page))
}

/// Generated scenes that are difficult.
pub const DIFFICULT: [&str; 10] = [
    "twins",
    "nested",
    "containers",
    "thin",
    "mirror",
    "glass",
    "dark",
    "sparse",
    "big",
    "bare",
];

/// A scene to measure.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSource {
    pub name: String,
    /// Folder of the photos; `None` if they are generated.
    pub photos: Option<PathBuf>,
    pub labelled: bool,
    /// Whether the user named it.
    pub given: bool,
}

impl SceneSource {
    /// Returns the scene of a folder of photos, or else of a kind of generated scene.
    pub fn of(text: &str) -> Self {
        let folder = Path::new(text);
        let name = folder.file_name().unwrap_or_default();
        Self {
            name: name.to_string_lossy().into_owned(),
            photos: folder.is_dir().then(|| folder.to_owned()),
            labelled: !folder.is_dir() || folder.join("labels").is_dir(),
            given: true,
        }
    }
}

/// A row to measure.
pub struct Planned<'a> {
    pub scene: &'a SceneSource,
    pub way: &'static Way,
    pub seed: u64,
}

/// Returns the difficult scenes that are not among the given ones.
pub fn difficult(given: &[SceneSource]) -> Vec<SceneSource> {
    let missing = DIFFICULT
        .iter()
        .filter(|kind| !given.iter().any(|scene| scene.name == **kind));
    missing
        .map(|kind| SceneSource {
            name: (*kind).to_owned(),
            photos: None,
            labelled: true,
            given: false,
        })
        .collect()
}

/// Returns the rows of all pages: first [`BASE`] with all seeds, then all other ways seed by seed,
/// so that an interrupted run has all ways before it has all seeds.
pub fn rows(scenes: &[SceneSource], seeds: u64) -> Vec<Planned<'_>> {
    let photographed: Vec<&SceneSource> = scenes
        .iter()
        .filter(|s| s.given && s.photos.is_some() && s.labelled)
        .take(2)
        .collect();
    let is_on = |scene: &SceneSource, way: &Way, seed: u64| match way.on {
        On::Given => scene.given && (scene.labelled || way.needs_no_labels()),
        On::TwoPhotographed => photographed.contains(&scene),
        On::TwoPhotographedOnce => seed == 0 && photographed.contains(&scene),
        On::Difficult => !scene.given,
    };
    let mut rows = Vec::new();
    for seed in 0..seeds {
        for way in WAYS {
            let on = scenes.iter().filter(|scene| is_on(scene, way, seed));
            rows.extend(on.map(|scene| Planned { scene, way, seed }));
        }
    }
    rows.sort_by_key(|row| row.way.name != BASE);
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn rows_are_distinct_and_the_default_way_comes_first() {
        let folder = tempfile::tempdir().expect("a folder");
        let photos = folder.path().join("fox");
        std::fs::create_dir(&photos).expect("photos");
        let mut scenes = vec![
            SceneSource::of(photos.to_str().expect("UTF-8")),
            SceneSource::of("table"),
        ];
        assert!(scenes[0].photos.is_some() && scenes[1].photos.is_none());
        scenes.extend(difficult(&scenes));
        assert_eq!(scenes.len(), 2 + DIFFICULT.len());
        let rows = rows(&scenes, 3);
        let first: Vec<(&str, u64)> = rows[..6]
            .iter()
            .map(|r| (r.scene.name.as_str(), r.seed))
            .collect();
        assert_eq!(
            first,
            [
                ("fox", 0),
                ("table", 0),
                ("fox", 1),
                ("table", 1),
                ("fox", 2),
                ("table", 2)
            ]
        );
        assert!(rows[..6].iter().all(|row| row.way.name == BASE));
        let distinct: BTreeSet<_> = rows
            .iter()
            .map(|r| (&r.scene.name, r.way.name, r.seed))
            .collect();
        assert_eq!(distinct.len(), rows.len());
        // Names are separated by commas on the command line.
        assert!(WAYS.iter().all(|way| !way.name.contains(',')));
        let of = |scene: &str| rows.iter().filter(|r| r.scene.name == scene).count();
        assert_eq!(of("twins"), 3, "difficult scenes have one way");
    }
}
