//! Names that the user has taught: examples under a name, to which every scene of the same encoder answers.

use crate::Result;
use crate::error::{Context, bail};
use fastlgs_core::fs;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What one lesson showed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Example {
    /// The encoder that embedded it.
    pub encoder: String,
    /// Where it was seen.
    pub from: String,
    /// Embeddings, one a view.
    pub embeddings: Vec<Vec<f32>>,
}

/// All names with their examples.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Names(BTreeMap<String, Vec<Example>>);

/// A name as it is kept: without capitals and superfluous spaces.
pub(crate) fn plain(name: &str) -> String {
    name.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase()
}

impl Names {
    /// The file that keeps them.
    pub fn path() -> PathBuf {
        fs::data_dir().join("names.json")
    }

    /// The user's names; none where nothing was taught yet.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn load() -> Result<Self> {
        let path = Self::path();
        if path.exists() { Self::read(&path) } else { Ok(Self::default()) }
    }

    /// Changes the user's names; whoever else does waits, so that no lesson is lost.
    ///
    /// # Errors
    /// A file that cannot be read or written, and what `change` returns; the names then stay as they were.
    pub fn change<T>(change: impl FnOnce(&mut Self) -> Result<T>) -> Result<T> {
        let path = Self::path();
        let _alone = fs::locked(&path)?;
        let mut names = Self::load()?;
        let out = change(&mut names)?;
        names.write(&path)?;
        Ok(out)
    }

    /// The names of a file that [`Self::write`] wrote.
    ///
    /// # Errors
    /// A file that cannot be read, or holds something else.
    pub fn read(path: &Path) -> Result<Self> {
        let names: Self = fs::read_json(path).with_context(|| format!("{}: no names that were exported", path.display()))?;
        let finite = |e: &Example| !e.embeddings.is_empty() && e.embeddings.iter().flatten().all(|v| v.is_finite());
        if let Some((name, _)) = names.0.iter().find(|(name, examples)| plain(name) != **name || !examples.iter().all(finite)) {
            bail!("{}: the name '{name}' is damaged; take it out of the file, or move the file away", path.display());
        }
        Ok(names)
    }

    /// Writes them to a file.
    ///
    /// # Errors
    /// The system's refusal; what was there before then stays.
    pub fn write(&self, path: &Path) -> Result<()> {
        Ok(fs::write_json(path, self)?)
    }

    /// The examples of a name, if it was taught.
    pub fn of(&self, name: &str) -> Option<&[Example]> {
        self.0.get(&plain(name)).map(Vec::as_slice)
    }

    /// Adds an example, unless it is there already.
    pub fn add(&mut self, name: &str, example: Example) {
        let examples = self.0.entry(plain(name)).or_default();
        if !examples.contains(&example) {
            examples.push(example);
        }
    }

    /// Adds the examples of others; how many names came.
    pub fn extend(&mut self, others: Self) -> usize {
        let count = others.0.len();
        for (name, examples) in others.0 {
            examples.into_iter().for_each(|example| self.add(&name, example));
        }
        count
    }

    /// Forgets a name.
    ///
    /// # Errors
    /// A name that was never taught.
    pub fn remove(&mut self, name: &str) -> Result<()> {
        match self.0.remove(&plain(name)) {
            Some(_) => Ok(()),
            None => bail!("'{name}' was never taught; 'fastlgs names list' shows what was"),
        }
    }

    /// What a list shows: each name with its examples.
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
    /// Lessons.
    pub examples: usize,
    /// Their embeddings.
    pub views: usize,
    /// Where they were seen.
    pub from: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_kept_without_capitals_and_forgotten_by_name() {
        let example = |from: &str| Example { encoder: "offline".into(), from: from.into(), embeddings: vec![vec![0.6, 0.8]] };
        let mut names = Names::default();
        names.add("Lis  rudy", example("a"));
        names.add("lis rudy", example("a"));
        names.add("LIS RUDY", example("b"));
        assert_eq!(names.of(" Lis Rudy ").map(<[Example]>::len), Some(2));
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("names.json");
        names.write(&path).expect("a file");
        let mut others = Names::default();
        assert_eq!(others.extend(Names::read(&path).expect("names")), 1);
        assert_eq!(others, names);
        assert_eq!(names.rows()[0].from, ["a", "b"]);
        names.remove("Lis rudy").expect("it was taught");
        assert!(names.remove("lis rudy").expect_err("gone").to_string().contains("never taught"));
        std::fs::write(&path, "{\"a\": [{\"encoder\": \"\", \"from\": \"\", \"embeddings\": []}]}").expect("a file");
        assert!(Names::read(&path).expect_err("damaged").to_string().contains("'a' is damaged"));
    }
}
