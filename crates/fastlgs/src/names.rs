//! Taught names: examples of objects under a name, for all scenes with the same encoder.

use crate::error::{Context, bail};
use crate::{Error, Result};
use fastlgs_core::fs;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// An example of a taught name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Example {
    /// Identity of the encoder that embedded it.
    pub encoder: String,
    /// Source: an object of a scene, or a picture file.
    pub from: String,
    /// Embeddings, one for each view.
    pub embeddings: Vec<Vec<f32>>,
}

/// All names with their examples.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Names(BTreeMap<String, Vec<Example>>);

/// Normalises a name: lower case, and one space between words.
pub(crate) fn normalise_name(name: &str) -> String {
    name.split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
        .to_lowercase()
}

impl Names {
    /// Returns the path of the user's file of names.
    pub fn path() -> PathBuf {
        fs::data_dir().join("names.json")
    }

    /// Loads the user's names; none if there is no file.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn load() -> Result<Self> {
        let path = Self::path();
        if path.exists() {
            Self::read(&path)
        } else {
            Ok(Self::default())
        }
    }

    /// Changes the user's names under a lock, so that no simultaneous change is lost. Returns the
    /// result of `change`.
    ///
    /// # Errors
    /// A file that cannot be read or written, or an error of `change`. The names then remain
    /// unchanged.
    pub fn change<T>(change: impl FnOnce(&mut Self) -> Result<T>) -> Result<T> {
        let path = Self::path();
        let _alone = fs::acquire_lock(&path)?;
        let mut names = Self::load()?;
        let out = change(&mut names)?;
        names.write(&path)?;
        Ok(out)
    }

    /// Reads the names of a file that [`Self::write`] wrote.
    ///
    /// # Errors
    /// A file that cannot be read, or has other contents.
    pub fn read(path: &Path) -> Result<Self> {
        let names: Self = fs::read_json(path).with_context(|| {
            format!(
                "{}: this is not a file that 'fastlgs names export' wrote",
                path.display()
            )
        })?;
        let finite = |e: &Example| {
            !e.embeddings.is_empty() && e.embeddings.iter().flatten().all(|v| v.is_finite())
        };
        if let Some((name, _)) = names
            .0
            .iter()
            .find(|(name, examples)| normalise_name(name) != **name || !examples.iter().all(finite))
        {
            bail!(
                "{}: the entry of the name '{name}' is damaged; remove it from the file, or move the file away",
                path.display()
            );
        }
        Ok(names)
    }

    /// Writes the names to a file.
    ///
    /// # Errors
    /// The file cannot be written. Its earlier contents then remain.
    pub fn write(&self, path: &Path) -> Result<()> {
        Ok(fs::write_json(path, self)?)
    }

    /// Returns the examples of a name; `None` if it was not taught.
    pub fn examples(&self, name: &str) -> Option<&[Example]> {
        self.0.get(&normalise_name(name)).map(Vec::as_slice)
    }

    /// Adds an example to a name, unless the name already has it.
    pub fn add(&mut self, name: &str, example: Example) {
        let examples = self.0.entry(normalise_name(name)).or_default();
        if !examples.contains(&example) {
            examples.push(example);
        }
    }

    /// Adds all examples of `others`, and returns the number of their names.
    pub fn extend(&mut self, others: Self) -> usize {
        let count = others.0.len();
        for (name, examples) in others.0 {
            examples
                .into_iter()
                .for_each(|example| self.add(&name, example));
        }
        count
    }

    /// Removes a name and its examples.
    ///
    /// # Errors
    /// A name that was not taught.
    pub fn remove(&mut self, name: &str) -> Result<()> {
        match self.0.remove(&normalise_name(name)) {
            Some(_) => Ok(()),
            None => Err(Error::NotFound(format!(
                "'{name}' was never taught; run 'fastlgs names list' to see all taught names"
            ))),
        }
    }

    /// Returns one row for each name, sorted by name.
    pub fn rows(&self) -> Vec<Row> {
        let row = |(name, examples): (&String, &Vec<Example>)| Row {
            name: name.clone(),
            examples: examples.len(),
            views: examples.iter().map(|e| e.embeddings.len()).sum(),
            from: examples.iter().map(|e| e.from.clone()).collect(),
        };
        self.0.iter().map(row).collect()
    }
}

/// A name in a list.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The name.
    pub name: String,
    /// Number of examples.
    pub examples: usize,
    /// Number of embeddings of all examples.
    pub views: usize,
    /// Source of each example.
    pub from: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_ignore_case_and_can_be_removed() {
        let example = |from: &str| Example {
            encoder: "offline".into(),
            from: from.into(),
            embeddings: vec![vec![0.6, 0.8]],
        };
        let mut names = Names::default();
        names.add("Lis  rudy", example("a"));
        names.add("lis rudy", example("a"));
        names.add("LIS RUDY", example("b"));
        assert_eq!(names.examples(" Lis Rudy ").map(<[Example]>::len), Some(2));
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("names.json");
        names.write(&path).expect("a file");
        let mut others = Names::default();
        assert_eq!(others.extend(Names::read(&path).expect("names")), 1);
        assert_eq!(others, names);
        assert_eq!(names.rows()[0].from, ["a", "b"]);
        names.remove("Lis rudy").expect("it was taught");
        assert!(
            names
                .remove("lis rudy")
                .expect_err("gone")
                .to_string()
                .contains("never taught")
        );
        std::fs::write(
            &path,
            "{\"a\": [{\"encoder\": \"\", \"from\": \"\", \"embeddings\": []}]}",
        )
        .expect("a file");
        assert!(
            Names::read(&path)
                .expect_err("damaged")
                .to_string()
                .contains("'a' is damaged")
        );
    }
}
