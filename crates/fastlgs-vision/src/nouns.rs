//! The classes of detector and classifier that a name means, by the synonyms and kinds of WordNet
//! (Miller 1995).

use crate::attributes;
use crate::detector::CLASSES;
use crate::{Result, model_paths};
use fastlgs_core::fs;
use serde::Deserialize;
use std::collections::HashMap;

/// File name of the nouns in the folder of the offline models.
pub(crate) const FILE: &str = "nouns.json";

/// Words after which a phrase describes its noun: "carton of juice".
const PREPOSITIONS: [&str; 7] = ["of", "with", "on", "in", "at", "for", "from"];

/// Endings of plurals and of their singulars, as in WordNet's morphology.
const PLURALS: [(&str, &str); 8] = [
    ("ches", "ch"),
    ("shes", "sh"),
    ("xes", "x"),
    ("ses", "s"),
    ("zes", "z"),
    ("ies", "y"),
    ("men", "man"),
    ("s", ""),
];

/// Classes that a name means.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub struct NamedClasses {
    /// Indices in [`CLASSES`] of the detector.
    pub detector: Vec<usize>,
    /// Indices of classes of the classifier.
    pub classifier: Vec<usize>,
}

impl NamedClasses {
    /// Returns whether the name means no class.
    pub fn is_empty(&self) -> bool {
        self.detector.is_empty() && self.classifier.is_empty()
    }
}

/// The nouns that name classes.
pub struct Nouns(HashMap<String, NamedClasses>);

impl Nouns {
    /// Returns whether the nouns are installed.
    pub fn is_installed() -> bool {
        model_paths::offline_dir().join(FILE).is_file()
    }

    /// Loads the nouns from the cache folder.
    ///
    /// # Errors
    /// When they are not installed.
    pub fn load() -> Result<Self> {
        Ok(Self(fs::read_json(&model_paths::offline_dir().join(FILE))?))
    }

    /// Returns the classes that a name means. A phrase that is not in WordNet means what its last
    /// words mean, without colours and materials: "office chair" is a chair.
    pub fn classes(&self, name: &str) -> NamedClasses {
        let name = name.to_lowercase();
        if let Some(classes) = self.entry(&name) {
            return classes;
        }
        let plain = attributes::of_text(&name).1;
        let words: Vec<&str> = plain.split_whitespace().collect();
        let described = words
            .iter()
            .skip(1)
            .position(|word| PREPOSITIONS.contains(word))
            .map_or(words.len(), |place| place + 1);
        (0..described)
            .find_map(|first| self.entry(&words[first..described].join(" ")))
            .unwrap_or_default()
    }

    /// Returns the classes of a noun, in singular or plural.
    fn entry(&self, noun: &str) -> Option<NamedClasses> {
        let class = |noun: &str| CLASSES.iter().position(|class| *class == noun);
        let known = |noun: &str| {
            class(noun)
                .map(|index| NamedClasses {
                    detector: vec![index],
                    classifier: Vec::new(),
                })
                .or_else(|| self.0.get(noun).cloned())
        };
        known(noun).or_else(|| {
            PLURALS.iter().find_map(|(plural, singular)| {
                let stem = noun.strip_suffix(plural)?;
                known(&format!("{stem}{singular}"))
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phrases_and_plurals_mean_the_classes_of_their_noun() {
        let file = r#"{"chair": {"detector": [56]}, "armchair": {"detector": [56]}, "curtain": {"classifier": [794, 854]},
            "picture frame": {}, "frame": {"classifier": [3]}, "carton": {"classifier": [478]}, "juice": {"classifier": [1]},
            "chest": {"classifier": [2]}, "chest of drawers": {"classifier": [493]}, "brown bear": {"detector": [21]}, "bear": {}}"#;
        let nouns = Nouns(serde_json::from_str(file).expect("nouns"));
        let detector = |name: &str| {
            let classes = nouns.classes(name).detector;
            classes.into_iter().map(|c| CLASSES[c]).collect::<Vec<_>>()
        };
        for name in [
            "chair",
            "Armchairs",
            "office chair",
            "blue chairs",
            "chair of wood",
            "chair in the corner",
        ] {
            assert_eq!(detector(name), ["chair"], "{name}");
        }
        assert_eq!(detector("wine glasses"), ["wine glass"]);
        assert_eq!(nouns.classes("red curtain").classifier, [794, 854]);
        assert_eq!(nouns.classes("carton of juice").classifier, [478]);
        assert_eq!(nouns.classes("chest of drawers").classifier, [493]);
        assert_eq!(detector("brown bear"), ["bear"]);
        assert!(nouns.classes("picture frame").is_empty());
        assert!(nouns.classes("of").is_empty() && nouns.classes("").is_empty());
    }

    #[test]
    fn wordnet_relates_names_to_classes() {
        let nouns = match Nouns::load() {
            Ok(nouns) => nouns,
            Err(e) => return crate::skip::skip(format_args!("{e}")),
        };
        let detected = [
            ("armchair", "chair"),
            ("office chair", "chair"),
            ("piano stool", "chair"),
            ("bonsai tree", "potted plant"),
            ("monitor", "tv"),
            ("desk", "dining table"),
            ("sofas", "couch"),
            ("mobile phone", "cell phone"),
        ];
        for (name, class) in detected {
            let classes = nouns.classes(name).detector;
            let names: Vec<&str> = classes.iter().map(|index| CLASSES[*index]).collect();
            assert_eq!(names, [class], "{name}");
        }
        // The classifier knows these, and the detector does not.
        for name in ["carton of juice", "fox", "table lamp", "bookcase"] {
            let classes = nouns.classes(name);
            assert!(classes.detector.is_empty(), "{name}: {classes:?}");
            assert!(!classes.classifier.is_empty(), "{name}");
        }
        for name in ["ceiling", "picture frame", "door", "zzyzx"] {
            assert!(nouns.classes(name).is_empty(), "{name}");
        }
    }
}
