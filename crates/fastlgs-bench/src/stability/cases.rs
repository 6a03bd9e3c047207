//! The disturbances of `fastlgs-bench stability`, and the accepted losses.

use crate::disturb::{MaskChange, PhotoChange};
use fastlgs_synth::Kind;

/// A disturbance.
#[derive(Clone)]
pub enum Change {
    /// All stages, from disturbed photos.
    Photos(PhotoChange),
    /// Training with other seeds, on the same prepared scene.
    Seed,
    /// Disturbed masks, mapped to the same Gaussians.
    Masks(MaskChange),
    /// Noise on the objects' embeddings. The value is its root mean square length.
    Embeddings(f32),
    /// Other mapping options, on the same Gaussians.
    Map(&'static [&'static str]),
    /// Other options of `eval`, on a scene with Algorithm 1's mapping and trained codes.
    Eval(&'static [&'static str]),
}

/// A row of the table.
pub struct Case {
    pub disturbance: &'static str,
    pub strength: &'static str,
    pub change: Change,
    /// The bounded figure: `oracle_miou` for disturbed photos, masks and mapping, `miou` for
    /// embedding noise.
    pub measure: &'static str,
    /// Accepted loss in points (hundredths of mIoU).
    pub bound: f64,
    /// Whether `--quick` runs this case.
    pub quick: bool,
}

/// Returns all disturbances, most of them with three strengths. The bounds of poses, views,
/// exposure, blur, focal length and seeds are goals of the project. The other bounds are 5 points
/// for common faults and 15 points for poor input.
pub fn cases() -> Vec<Case> {
    let case = |disturbance, strength, change, bound, quick| Case {
        disturbance,
        strength,
        change,
        measure: "oracle_miou",
        bound,
        quick,
    };
    let text = |disturbance, strength, change, bound, quick| Case {
        disturbance,
        strength,
        change,
        measure: "miou",
        bound,
        quick,
    };
    let photos = |disturbance, strength, change, bound, quick| {
        case(disturbance, strength, Change::Photos(change), bound, quick)
    };
    let masks = |disturbance, strength, change, bound, quick| {
        case(disturbance, strength, Change::Masks(change), bound, quick)
    };
    let map = |disturbance, strength, args, quick| {
        case(disturbance, strength, Change::Map(args), 10.0, quick)
    };
    vec![
        photos("photos shuffled", "", PhotoChange::Shuffled, 3.0, true),
        photos("pose noise", "1 px", PhotoChange::Pose(1.0), 1.0, false),
        photos("pose noise", "2 px", PhotoChange::Pose(2.0), 3.0, true),
        photos("pose noise", "4 px", PhotoChange::Pose(4.0), 8.0, false),
        photos(
            "views missing",
            "25 %",
            PhotoChange::Missing(0.25),
            1.0,
            false,
        ),
        photos(
            "views missing",
            "50 %",
            PhotoChange::Missing(0.5),
            2.0,
            true,
        ),
        photos(
            "views missing",
            "75 %",
            PhotoChange::Missing(0.75),
            10.0,
            false,
        ),
        photos(
            "exposure",
            "0.25 stops",
            PhotoChange::Exposure(0.25),
            5.0,
            false,
        ),
        photos(
            "exposure",
            "0.5 stops",
            PhotoChange::Exposure(0.5),
            2.0,
            true,
        ),
        photos("exposure", "1 stop", PhotoChange::Exposure(1.0), 8.0, false),
        photos(
            "white balance",
            "5 %",
            PhotoChange::WhiteBalance(0.05),
            5.0,
            false,
        ),
        photos(
            "white balance",
            "10 %",
            PhotoChange::WhiteBalance(0.1),
            5.0,
            true,
        ),
        photos(
            "white balance",
            "20 %",
            PhotoChange::WhiteBalance(0.2),
            15.0,
            false,
        ),
        photos("blur", "0.5 px", PhotoChange::Blur(0.5), 5.0, false),
        photos("blur", "1 px", PhotoChange::Blur(1.0), 5.0, true),
        photos("blur", "2 px", PhotoChange::Blur(2.0), 3.0, false),
        photos("JPEG", "quality 70", PhotoChange::Jpeg(70), 5.0, false),
        photos("JPEG", "quality 40", PhotoChange::Jpeg(40), 5.0, true),
        photos("JPEG", "quality 15", PhotoChange::Jpeg(15), 15.0, false),
        photos("focal length", "1 %", PhotoChange::Focal(0.01), 5.0, false),
        photos("focal length", "3 %", PhotoChange::Focal(0.03), 3.0, true),
        photos("focal length", "10 %", PhotoChange::Focal(0.1), 10.0, false),
        case("seed", "spread", Change::Seed, 1.0, true),
        masks("masks eroded", "1 px", MaskChange::Eroded(1), 5.0, false),
        masks("masks eroded", "2 px", MaskChange::Eroded(2), 5.0, true),
        masks("masks eroded", "4 px", MaskChange::Eroded(4), 15.0, false),
        masks("masks split", "10 %", MaskChange::Split(0.1), 5.0, false),
        masks("masks split", "20 %", MaskChange::Split(0.2), 5.0, true),
        masks("masks split", "40 %", MaskChange::Split(0.4), 15.0, false),
        masks("masks merged", "10 %", MaskChange::Merged(0.1), 5.0, false),
        masks("masks merged", "20 %", MaskChange::Merged(0.2), 5.0, true),
        masks("masks merged", "40 %", MaskChange::Merged(0.4), 15.0, false),
        masks(
            "masks dropped",
            "10 %",
            MaskChange::Dropped(0.1),
            5.0,
            false,
        ),
        masks("masks dropped", "20 %", MaskChange::Dropped(0.2), 5.0, true),
        masks(
            "masks dropped",
            "40 %",
            MaskChange::Dropped(0.4),
            15.0,
            false,
        ),
        text(
            "embedding noise",
            "25 %",
            Change::Embeddings(0.25),
            5.0,
            false,
        ),
        text(
            "embedding noise",
            "50 %",
            Change::Embeddings(0.5),
            5.0,
            true,
        ),
        text(
            "embedding noise",
            "100 %",
            Change::Embeddings(1.0),
            15.0,
            false,
        ),
        map("support", "0.1", &["--support", "0.1"], false),
        map("support", "0.7", &["--support", "0.7"], false),
        map(
            "paper: tau",
            "1",
            &["--mapping", "paper", "--tau", "1"],
            false,
        ),
        map(
            "paper: tau",
            "10",
            &["--mapping", "paper", "--tau", "10"],
            true,
        ),
        map(
            "paper: tau",
            "30",
            &["--mapping", "paper", "--tau", "30"],
            false,
        ),
        map(
            "paper: theta",
            "0.3",
            &["--mapping", "paper", "--theta", "0.3"],
            false,
        ),
        map(
            "paper: theta",
            "0.8",
            &["--mapping", "paper", "--theta", "0.8"],
            true,
        ),
        map(
            "paper: theta",
            "0.98",
            &["--mapping", "paper", "--theta", "0.98"],
            false,
        ),
        map(
            "paper: alpha",
            "0.05",
            &["--mapping", "paper", "--alpha", "0.05"],
            false,
        ),
        map(
            "paper: alpha",
            "0.2",
            &["--mapping", "paper", "--alpha", "0.2"],
            true,
        ),
        map(
            "paper: alpha",
            "0.5",
            &["--mapping", "paper", "--alpha", "0.5"],
            false,
        ),
        case(
            "paper: tau_ac",
            "1",
            Change::Eval(&["--tau-ac", "1"]),
            10.0,
            false,
        ),
        case(
            "paper: tau_ac",
            "3",
            Change::Eval(&["--tau-ac", "3"]),
            10.0,
            true,
        ),
        case(
            "paper: tau_ac",
            "5",
            Change::Eval(&["--tau-ac", "5"]),
            10.0,
            false,
        ),
        case(
            "paper: tau_ac",
            "10",
            Change::Eval(&["--tau-ac", "10"]),
            10.0,
            false,
        ),
        case(
            "paper: tau_ac",
            "20",
            Change::Eval(&["--tau-ac", "20"]),
            10.0,
            false,
        ),
    ]
}

/// Returns the smallest accepted oracle mIoU of a generated scene. It is a goal of the project, or
/// else a value that users would call good.
pub fn kind_bound(kind: Kind) -> f64 {
    match kind {
        Kind::Dark => 0.9,
        Kind::Thin | Kind::Glass | Kind::Long | Kind::Nested => 0.85,
        Kind::Containers => 0.9,
        // Its objects are only 15 pixels large.
        Kind::Big => 0.5,
        _ => 0.8,
    }
}

/// Smallest accepted value of `apart` on the twins: the share of a label's pixels that are not
/// covered by the best object of another label.
pub const TWINS_APART: f64 = 0.95;
