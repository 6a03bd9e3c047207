//! Reads the embeddings of names, rooms and pictures for `fastlgs-bench clip`.

use anyhow::{Context, Result, bail};
use fastlgs_core::{fs, npy};
use fastlgs_grid::calibration::Calibration;
use fastlgs_grid::relevancy::TextQuery;
use fastlgs_grid::{Grid, Object};
use glam::Vec3;
use serde::Deserialize;
use std::path::Path;

/// Groups of names in `texts.json`.
#[derive(Deserialize)]
pub struct Groups {
    pub texts: Vec<String>,
    pub canonical: Vec<String>,
    pub absent: Vec<String>,
    pub present: Vec<String>,
    pub furniture: Vec<String>,
}

/// Names with their embeddings.
pub struct Names {
    pub groups: Groups,
    pub rows: Vec<Vec<f32>>,
}

/// A room: its objects with one embedding each.
pub struct Room {
    pub name: String,
    pub grid: Grid,
}

impl Names {
    pub fn load(folder: &Path) -> Result<Self> {
        let path = folder.join("texts.json");
        let groups: Groups = fs::read_json(&path)?;
        let rows = embeddings(&folder.join("texts.npy"))?;
        if rows.len() != groups.texts.len() {
            bail!(
                "{}: it names {} texts, but texts.npy has {} rows; save one row for each text",
                path.display(),
                groups.texts.len(),
                rows.len()
            );
        }
        let lists = [
            &groups.canonical,
            &groups.absent,
            &groups.present,
            &groups.furniture,
        ];
        if let Some(unknown) = lists
            .into_iter()
            .flatten()
            .find(|name| !groups.texts.contains(name))
        {
            bail!(
                "{}: '{unknown}' is in a group but not in 'texts'; add it, with its row in texts.npy",
                path.display()
            );
        }
        if lists.iter().any(|list| list.is_empty()) {
            bail!(
                "{}: each of 'canonical', 'absent', 'present' and 'furniture' needs a name",
                path.display()
            );
        }
        Ok(Self { groups, rows })
    }

    /// Returns the embedding of a name.
    pub fn row(&self, name: &str) -> Vec<f32> {
        let place = self.groups.texts.iter().position(|text| text == name);
        self.rows[place.expect("checked by load")].clone()
    }

    pub fn query(&self, name: &str, calibration: Calibration) -> TextQuery {
        TextQuery {
            canonical: self.groups.canonical.iter().map(|c| self.row(c)).collect(),
            ..TextQuery::new(vec![self.row(name)], calibration)
        }
    }
}

/// Reads a table of embeddings, L2-normalised.
pub fn embeddings(path: &Path) -> Result<Vec<Vec<f32>>> {
    let table = npy::read(path)?;
    let &[rows, length] = &table.shape[..] else {
        bail!(
            "{}: a table of embeddings has two dimensions, this one has {}",
            path.display(),
            table.shape.len()
        );
    };
    if rows == 0 || length == 0 {
        bail!(
            "{}: it holds no embeddings; save one row for each object or text",
            path.display()
        );
    }
    let unit = |row: &[f64]| -> Result<Vec<f32>> {
        let norm = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(norm > 0.0 && norm.is_finite()) {
            bail!("{}: a row is zero or not finite; remove it", path.display());
        }
        Ok(row.iter().map(|v| (v / norm) as f32).collect())
    };
    table.values.chunks_exact(length).map(unit).collect()
}

/// Reads all rooms, in order of their names.
pub fn load_rooms(folder: &Path, length: usize) -> Result<Vec<Room>> {
    let mut rooms = Vec::new();
    for name in stems(folder, ".views.npy")? {
        let path = folder.join(format!("{name}.npy"));
        let rows = embeddings(&path)?;
        if rows[0].len() != length {
            bail!(
                "{}: its embeddings have {} dimensions, but those of texts.npy have {length}; use texts of the same model",
                path.display(),
                rows[0].len()
            );
        }
        let views = npy::read(&folder.join(format!("{name}.views.npy")))?.values;
        if views.len() != rows.len() {
            bail!(
                "{}: it has {} objects, but {name}.views.npy has {}; save both from the same objects",
                path.display(),
                rows.len(),
                views.len()
            );
        }
        let objects = (1..)
            .zip(rows)
            .zip(&views)
            .map(|((id, row), views)| Object {
                id,
                parent: 0,
                support: 1.0,
                code: Vec3::ZERO,
                embeddings: vec![row],
                areas: vec![1.0],
                views: *views as usize,
                detected: None,
            });
        let grid = Grid {
            objects: objects.collect(),
            ..Grid::default()
        };
        rooms.push(Room { name, grid });
    }
    if rooms.is_empty() {
        bail!(
            "{}: it holds no room; a room is ROOM.npy with ROOM.views.npy",
            folder.display()
        );
    }
    Ok(rooms)
}

/// Returns the names of the files in a folder that end with `ending`, without it, sorted.
pub fn stems(folder: &Path, ending: &str) -> Result<Vec<String>> {
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("{}: the folder cannot be read", folder.display()))?;
    let mut names = Vec::new();
    for entry in entries {
        let name = entry?.file_name().to_string_lossy().into_owned();
        names.extend(name.strip_suffix(ending).map(str::to_owned));
    }
    names.sort();
    Ok(names)
}
