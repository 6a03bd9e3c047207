//! The rows of `fastlgs-bench all`: scenes, ways and seeds.

use super::ways::{BASE, On, WAYS, Way};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

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
pub fn rows<'a>(scenes: &'a [SceneSource], seeds: &[u64]) -> Vec<Planned<'a>> {
    let seeds: BTreeSet<u64> = seeds.iter().copied().collect();
    let first = seeds.first().copied();
    let labelled: Vec<&SceneSource> = scenes.iter().filter(|s| s.given && s.labelled).collect();
    let photographed: Vec<&SceneSource> = labelled
        .iter()
        .copied()
        .filter(|s| s.photos.is_some())
        .collect();
    let is_among = |scene: &SceneSource, scenes: &[&SceneSource], number: usize| {
        scenes.iter().take(number).any(|s| *s == scene)
    };
    let is_on = |scene: &SceneSource, way: &Way, seed: u64| match way.on {
        On::Given => scene.given && (scene.labelled || way.needs_no_labels()),
        On::Photographed(number) => is_among(scene, &photographed, number),
        On::LabelledOnce(number) => Some(seed) == first && is_among(scene, &labelled, number),
        On::Difficult => !scene.given,
    };
    let mut rows = Vec::new();
    for seed in seeds {
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
        let rows = rows(&scenes, &[0, 1, 2]);
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

    #[test]
    fn ways_of_photographs_are_on_the_first_scenes() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut scenes: Vec<SceneSource> = ["fox", "office", "bonsai", "apartment"]
            .iter()
            .map(|name| {
                let photos = folder.path().join(name);
                std::fs::create_dir_all(photos.join("labels")).expect("labels");
                SceneSource::of(photos.to_str().expect("UTF-8"))
            })
            .collect();
        scenes.insert(3, SceneSource::of("table"));
        let rows = rows(&scenes, &[0, 1]);
        let of = |way: &str| -> Vec<(&str, u64)> {
            let rows = rows.iter().filter(|row| row.way.name == way);
            rows.map(|r| (r.scene.name.as_str(), r.seed)).collect()
        };
        assert_eq!(of("side 240").len(), 2 * 3);
        assert!(!of("side 240").contains(&("apartment", 0)));
        assert_eq!(of("blur 2 px").len(), 2 * 2);
        assert_eq!(of("preset like-paper"), [("fox", 0), ("office", 0)]);
        let scenes = ["fox", "office", "bonsai", "table"];
        assert_eq!(of("preset paper"), scenes.map(|scene| (scene, 0)));
    }
}
