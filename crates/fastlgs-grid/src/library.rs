//! Many scenes at once: which of them hold what a text names.
//!
//! A library is one file with the embeddings of all objects of all scenes, twice: whole, in eight bits a number, and as their
//! coordinates along the directions in which the embeddings differ most (principal components), in eight bits as well. A search
//! compares the text with the short ones of all objects, and with the whole ones of those that come nearest.

use crate::grid::{Grid, Object};
use crate::query;
use crate::relevancy::TextQuery;
use crate::{Error, Result};
use fastlgs_core::{Error as CoreError, fs};
use nalgebra::DMatrix;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, Metadata, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Mutex;

/// Principal components that are kept. Most of 64 are spent on what examples are compared by: of ten objects that are most like words six are among the
/// nearest hundredth by these, nine by 96 and all ten by 128 (three photographed scenes, 3,086 embeddings).
const COMPONENTS: usize = 128;
/// Embeddings from which they are found, evenly spread.
const SAMPLES: usize = 8_192;
/// Objects that are compared in full.
const SHORT_LIST: usize = 1_024;

/// A scene of a library.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// Where it is, relative to the library's folder.
    pub path: String,
    /// What its table looked like when it was taken in; another stamp means that it has changed.
    pub stamp: String,
}

/// What is kept of an object beside its embeddings.
#[derive(Clone, Copy, Debug)]
struct Row {
    scene: u32,
    id: u16,
    support: f32,
    /// Its embeddings: first and number.
    first: usize,
    count: usize,
}

/// An opened library.
pub struct Library {
    /// Its scenes.
    pub scenes: Vec<Entry>,
    /// Numbers of an embedding.
    pub dimension: usize,
    rows: Vec<Row>,
    /// Share of its photo that each embedding's mask covered.
    areas: Vec<f32>,
    /// Largest component of each embedding: what 127 stands for.
    scales: Vec<f32>,
    /// `[COMPONENTS][dimension]`.
    basis: Vec<f32>,
    /// `[embeddings][COMPONENTS]`.
    short: Vec<i8>,
    /// The file, and where in it the whole embeddings `[embeddings][dimension]` begin.
    whole: Mutex<(File, u64)>,
}

/// A scene, by the object that is most like what is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Found {
    /// Index into [`Library::scenes`].
    pub scene: usize,
    /// The object.
    pub object: u16,
    /// By how much it is more like what is asked for than like anything.
    pub margin: f32,
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Sum of products of two rows of eight-bit numbers.
fn dot8(a: &[i8], b: &[i16]) -> i32 {
    a.iter().zip(b).map(|(x, y)| i32::from(i16::from(*x) * y)).sum()
}

/// Values of at most 1 after division by `most`, as eight bits.
fn quantised(values: &[f32], most: f32) -> impl Iterator<Item = i8> {
    values.iter().map(move |v| (v / most * 127.0).round().clamp(-127.0, 127.0) as i8)
}

/// The directions in which `samples` differ most from their mean, longest first: `[COMPONENTS][dimension]`.
fn principal_components(samples: &[&[f32]], dimension: usize) -> Vec<f32> {
    if dimension == 0 {
        return Vec::new();
    }
    let n = samples.len().max(1) as f32;
    let mean: Vec<f32> = (0..dimension).map(|k| samples.iter().map(|s| s[k]).sum::<f32>() / n).collect();
    let centred = DMatrix::from_fn(samples.len(), dimension, |i, k| samples[i][k] - mean[k]);
    let eigen = (centred.tr_mul(&centred) / n).symmetric_eigen();
    let mut order: Vec<usize> = (0..dimension).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]).then(a.cmp(b)));
    let mut basis: Vec<f32> =
        order.into_iter().take(COMPONENTS).flat_map(|k| eigen.eigenvectors.column(k).iter().copied().collect::<Vec<_>>()).collect();
    // Short embeddings need fewer.
    basis.resize(COMPONENTS * dimension, 0.0);
    basis
}

/// Writes the library of these scenes.
///
/// # Errors
/// When scenes have embeddings of different length; the system's refusal.
pub fn write(path: &Path, scenes: &[(Entry, Grid)]) -> Result<()> {
    let dimension = scenes.iter().flat_map(|s| &s.1.objects).flat_map(|o| &o.embeddings).map(Vec::len).next().unwrap_or(0);
    let mut embeddings: Vec<&[f32]> = Vec::new();
    let (mut objects, mut areas): (Vec<u32>, Vec<f32>) = (Vec::new(), Vec::new());
    for (scene, (entry, grid)) in scenes.iter().enumerate() {
        for object in &grid.objects {
            if let Some(odd) = object.embeddings.iter().find(|e| e.len() != dimension) {
                let reason = format!("{}: its embeddings have {} numbers, those of other scenes {dimension}", entry.path, odd.len());
                return Err(Error::Core(CoreError::format(path, reason)));
            }
            objects.extend([
                scene as u32,
                u32::from(object.id),
                object.support.to_bits(),
                embeddings.len() as u32,
                object.embeddings.len() as u32,
            ]);
            embeddings.extend(object.embeddings.iter().map(Vec::as_slice));
            areas.extend(&object.areas);
        }
    }
    let step = embeddings.len().div_ceil(SAMPLES).max(1);
    let basis = principal_components(&embeddings.iter().step_by(step).copied().collect::<Vec<_>>(), dimension);
    let along: Vec<Vec<f32>> = embeddings.par_iter().map(|e| basis.chunks_exact(dimension.max(1)).map(|b| dot(b, e)).collect()).collect();
    let most = along.par_iter().flatten().fold(|| 1e-9f32, |m, v| m.max(v.abs())).reduce(|| 1e-9, f32::max);
    let short: Vec<i8> = along.iter().flat_map(|row| quantised(row, most)).collect();
    let scales: Vec<f32> = embeddings.iter().map(|e| e.iter().fold(1e-9f32, |m, v| m.max(v.abs()))).collect();
    let whole: Vec<i8> = embeddings.iter().zip(&scales).flat_map(|(e, scale)| quantised(e, *scale)).collect();

    let n = embeddings.len();
    let entries: Vec<&Entry> = scenes.iter().map(|s| &s.0).collect();
    let entries = serde_json::to_string(&entries).map_err(|e| CoreError::format(path, e.to_string()))?;
    // One entry: of several the order would be chance.
    let metadata = HashMap::from([("scenes".to_owned(), entries)]);
    let tensor =
        |kind, shape: Vec<usize>, data| TensorView::new(kind, shape, data).map_err(|e| Error::Core(CoreError::format(path, e.to_string())));
    let tensors = [
        ("areas", tensor(Dtype::F32, vec![n], bytemuck::cast_slice(&areas))?),
        ("basis", tensor(Dtype::F32, vec![COMPONENTS, dimension], bytemuck::cast_slice(&basis))?),
        ("objects", tensor(Dtype::U32, vec![objects.len() / 5, 5], bytemuck::cast_slice(&objects))?),
        ("scales", tensor(Dtype::F32, vec![n], bytemuck::cast_slice(&scales))?),
        ("short", tensor(Dtype::I8, vec![n, COMPONENTS], bytemuck::cast_slice(&short))?),
        ("whole", tensor(Dtype::I8, vec![n, dimension], bytemuck::cast_slice(&whole))?),
    ];
    let data = safetensors::serialize(tensors, Some(metadata)).map_err(|e| CoreError::format(path, e.to_string()))?;
    Ok(fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))?)
}

impl Library {
    /// Opens a library; all but the whole embeddings is read.
    ///
    /// # Errors
    /// Missing, truncated or damaged files.
    pub fn open(path: &Path) -> Result<Self> {
        let bad = |reason: &str| Error::Core(CoreError::format(path, format!("{reason}; remove it, and it is made anew")));
        let io = |e: std::io::Error| Error::Core(CoreError::Io { path: path.to_owned(), source: e });
        let mut file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut head = [0; 8];
        file.read_exact(&mut head).map_err(|_| bad("truncated"))?;
        let head_length =
            u64::from_le_bytes(head).checked_add(8).filter(|n| *n <= length).ok_or_else(|| bad("not a library, or truncated"))?;
        let mut header = vec![0; head_length as usize];
        file.rewind().and_then(|()| file.read_exact(&mut header)).map_err(io)?;
        // Only the header is in memory; offsets are checked when they are used.
        let metadata: Metadata = serde_json::from_slice(&header[8..]).map_err(|e| bad(&format!("not a library ({e})")))?;
        let info: BTreeMap<String, (Vec<usize>, (usize, usize))> =
            metadata.tensors().into_iter().map(|(name, i)| (name, (i.shape.clone(), i.data_offsets))).collect();
        let whole_file = |(_, (from, to)): &&(Vec<usize>, (usize, usize))| from <= to && head_length.saturating_add(*to as u64) <= length;
        let place = |name: &str| info.get(name).filter(whole_file).ok_or_else(|| bad(&format!("truncated, or tensor '{name}' is missing")));
        let mut bytes = |name: &str| -> Result<Vec<u8>> {
            let (_, (from, to)) = place(name)?;
            let mut data = vec![0; to - from];
            file.seek(SeekFrom::Start(head_length + *from as u64)).and_then(|_| file.read_exact(&mut data)).map_err(io)?;
            Ok(data)
        };
        let floats = |data: Vec<u8>| -> Vec<f32> { data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect() };
        let (areas, basis, scales) = (floats(bytes("areas")?), floats(bytes("basis")?), floats(bytes("scales")?));
        let short: Vec<i8> = bytemuck::cast_vec(bytes("short")?);
        let words: Vec<u32> = bytes("objects")?.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        let scenes = metadata.metadata().as_ref().and_then(|m| m.get("scenes")).ok_or_else(|| bad("not a library"))?;
        let scenes: Vec<Entry> = serde_json::from_str(scenes).map_err(|_| bad("its list of scenes is damaged"))?;
        let (shape, (from, to)) = place("whole")?;
        let dimension = shape.get(1).copied().unwrap_or(0);
        let n = areas.len();
        let rows: Vec<Row> = words
            .chunks_exact(5)
            .map(|w| Row { scene: w[0], id: w[1] as u16, support: f32::from_bits(w[2]), first: w[3] as usize, count: w[4] as usize })
            .collect();
        let fits = scales.len() == n
            && short.len() == n * COMPONENTS
            && basis.len() == COMPONENTS * dimension
            && to - from == n * dimension
            && rows.iter().all(|r| r.first + r.count <= n && (r.scene as usize) < scenes.len());
        if !fits {
            return Err(bad("its parts do not fit together"));
        }
        let whole = Mutex::new((file, head_length + *from as u64));
        Ok(Self { scenes, dimension, rows, areas, scales, basis, short, whole })
    }

    /// Objects of all scenes.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Of each scene that may hold what is asked for the object that is most like it by itself, likeliest scene first; at most `scenes` of them.
    /// What a scene then answers, and how sure that is, [`query::rank`] tells.
    ///
    /// # Errors
    /// A query of another encoder; the system's refusal to read the file.
    pub fn search(&self, query: &TextQuery, scenes: usize) -> Result<Vec<Found>> {
        let length = query.meant.first().map_or(0, Vec::len);
        if length != self.dimension && !self.is_empty() {
            let reason =
                format!("the library's embeddings have {} numbers, the text's {length}: they are of different encoders", self.dimension);
            return Err(Error::Core(CoreError::Invalid(reason)));
        }
        let mut best: BTreeMap<usize, Found> = BTreeMap::new();
        for (row, object) in self.in_full(&self.nearest(&query.meant))? {
            let Some(margin) = query::margin(&object, query) else { continue };
            let own = Found { scene: row.scene as usize, object: row.id, margin };
            let of_scene = best.entry(own.scene).or_insert(own);
            if margin > of_scene.margin {
                *of_scene = own;
            }
        }
        let mut found: Vec<Found> = best.into_values().collect();
        found.sort_by(|a, b| b.margin.total_cmp(&a.margin).then(a.scene.cmp(&b.scene)));
        found.truncate(scenes);
        Ok(found)
    }

    /// The objects whose short embeddings come nearest to what is meant, in the order of the file.
    fn nearest(&self, meant: &[Vec<f32>]) -> Vec<usize> {
        let along = |one: &Vec<f32>| -> Vec<f32> { self.basis.chunks_exact(self.dimension.max(1)).map(|b| dot(b, one)).collect() };
        let along: Vec<Vec<f32>> = meant.iter().map(along).collect();
        let most = along.iter().flatten().fold(1e-9f32, |m, v| m.max(v.abs()));
        let along: Vec<Vec<i16>> = along.iter().map(|a| quantised(a, most).map(i16::from).collect()).collect();
        let near = |row: &Row| {
            let own = self.short[row.first * COMPONENTS..(row.first + row.count) * COMPONENTS].chunks_exact(COMPONENTS);
            own.flat_map(|e| along.iter().map(move |a| dot8(e, a))).max().unwrap_or(i32::MIN)
        };
        let mut scored: Vec<(i32, u32)> =
            self.rows.par_iter().enumerate().with_min_len(4096).map(|(k, row)| (near(row), k as u32)).collect();
        let keep = SHORT_LIST.min(scored.len());
        if keep < scored.len() {
            scored.select_nth_unstable_by_key(keep, |(score, k)| (std::cmp::Reverse(*score), *k));
        }
        let mut short_list: Vec<usize> = scored[..keep].iter().map(|(_, k)| *k as usize).collect();
        short_list.sort_unstable();
        short_list
    }

    /// Objects with their whole embeddings.
    fn in_full(&self, objects: &[usize]) -> Result<Vec<(Row, Object)>> {
        let whole = self.whole.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let (mut file, start) = (&whole.0, whole.1);
        let mut data = Vec::new();
        let mut out = Vec::with_capacity(objects.len());
        for row in objects.iter().map(|k| self.rows[*k]) {
            data.resize(row.count * self.dimension, 0u8);
            file.seek(SeekFrom::Start(start + (row.first * self.dimension) as u64))
                .and_then(|_| file.read_exact(&mut data))
                .map_err(|source| CoreError::Io { path: "the library".into(), source })?;
            let embedding = |(k, e): (usize, &[u8])| e.iter().map(|b| f32::from(*b as i8) * self.scales[row.first + k] / 127.0).collect();
            let object = Object {
                id: row.id,
                parent: 0,
                support: row.support,
                code: glam::Vec3::ZERO,
                embeddings: data.chunks_exact(self.dimension.max(1)).enumerate().map(embedding).collect(),
                areas: self.areas[row.first..row.first + row.count].to_vec(),
                views: row.count,
            };
            out.push((row, object));
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use fastlgs_core::rng::Rng;

    /// Numbers that texts are compared by, and those that examples are.
    const DIMENSION: usize = 384;
    const APPEARANCE: usize = 64;

    fn unit(mut v: Vec<f32>) -> Vec<f32> {
        let length = dot(&v, &v).sqrt();
        v.iter_mut().for_each(|v| *v /= length);
        v
    }

    /// A text's embedding, which looks like nothing.
    fn text(concept: &[f32]) -> Vec<f32> {
        [concept, &[0.0; APPEARANCE]].concat()
    }

    /// Embeddings as encoders make them: mixtures of some concepts, and noise; then what tells single things apart.
    fn scenes(count: usize, objects: u16, concepts: &[Vec<f32>]) -> Vec<(Entry, Grid)> {
        let mut rng = Rng::new(7, "library");
        let mut pick = |n: usize| ((rng.uniform() * n as f32) as usize).min(n - 1);
        let mut noise = Rng::new(8, "library");
        (0..count)
            .map(|k| {
                let object = |id: u16| {
                    let own = pick(concepts.len());
                    let look = unit((0..APPEARANCE).map(|_| noise.uniform() - 0.5).collect());
                    let embeddings: Vec<Vec<f32>> = (0..1 + pick(5))
                        .map(|_| {
                            let other = pick(concepts.len());
                            let mixed = |d| concepts[own][d] + 0.5 * concepts[other][d] + 0.02 * (noise.uniform() - 0.5);
                            [unit((0..DIMENSION).map(mixed).collect()), look.clone()].concat()
                        })
                        .collect();
                    let areas = vec![0.1; embeddings.len()];
                    let support = 0.5 + 0.01 * f32::from(id % 40);
                    Object { id, parent: 0, support, code: glam::Vec3::ZERO, views: embeddings.len(), embeddings, areas }
                };
                let objects = (1..=objects).map(object).collect();
                (Entry { path: format!("scene{k}"), stamp: "1".into() }, Grid { objects, ..Grid::default() })
            })
            .collect()
    }

    fn concepts(n: usize) -> Vec<Vec<f32>> {
        let mut rng = Rng::new(3, "concepts");
        (0..n).map(|_| unit((0..DIMENSION).map(|_| rng.uniform() - 0.5).collect())).collect()
    }

    #[test]
    fn a_search_finds_what_a_query_of_each_scene_would() {
        let concepts = concepts(300);
        let scenes = scenes(40, 60, &concepts);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("library.index");
        write(&path, &scenes).unwrap();
        let library = Library::open(&path).unwrap();
        assert_eq!((library.len(), library.scenes.len()), (2400, 40));
        let (mut same, mut asked) = (0, 0);
        for concept in concepts.iter().take(50) {
            let query = TextQuery::new(vec![text(concept)], Calibration::OFFLINE);
            let mut exact: Vec<Found> = Vec::new();
            for (k, (_, grid)) in scenes.iter().enumerate() {
                let own = |object: &Object| (query::margin(object, &query).unwrap(), object.id);
                let (margin, id) = grid.objects.iter().map(own).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
                exact.push(Found { scene: k, object: id, margin });
            }
            exact.sort_by(|a, b| b.margin.total_cmp(&a.margin));
            for (found, own) in library.search(&query, 5).unwrap().iter().zip(&exact) {
                asked += 1;
                // Embeddings are rounded: what is nearly level may change places.
                same += u32::from((found.margin - own.margin).abs() < 0.002);
                assert!((found.margin - own.margin).abs() < 0.002 || found.scene != own.scene, "{found:?} {own:?}");
            }
        }
        assert!(same * 100 >= asked * 95, "{same} of {asked} as good as by asking each scene");
        let short = TextQuery::new(vec![vec![1.0]], Calibration::OFFLINE);
        assert!(library.search(&short, 5).unwrap_err().to_string().contains("different encoders"));
    }

    #[test]
    fn damaged_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("library.index");
        write(&path, &scenes(3, 10, &concepts(20))).unwrap();
        let data = std::fs::read(&path).unwrap();
        for length in [0, 4, 100, data.len() / 2, data.len() - 1] {
            std::fs::write(&path, &data[..length]).unwrap();
            let said = Library::open(&path).err().expect("an error").to_string();
            assert!(said.contains("library.index") && said.contains("made anew"), "{said}");
        }
        write(&path, &[]).unwrap();
        assert!(Library::open(&path).unwrap().is_empty());
    }

    /// 1,000 scenes of 300 objects: 1.5 million embeddings.
    #[test]
    fn a_thousand_scenes_are_searched_in_milliseconds() {
        let concepts = concepts(1_000);
        let scenes = scenes(1_000, 300, &concepts);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("library.index");
        let started = std::time::Instant::now();
        write(&path, &scenes).unwrap();
        let built = started.elapsed().as_secs_f64();
        drop(scenes);
        let library = Library::open(&path).unwrap();
        let mut milliseconds: Vec<f64> = (0..20)
            .map(|k| {
                let query = TextQuery::new(vec![text(&concepts[k])], Calibration::OFFLINE);
                let started = std::time::Instant::now();
                assert_eq!(library.search(&query, 10).unwrap().len(), 10);
                started.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        milliseconds.sort_by(f64::total_cmp);
        let bytes = std::fs::metadata(&path).unwrap().len();
        println!(
            "{} objects, {bytes} bytes, written in {built:.1} s: {:.1} ms (median), {:.1} ms (slowest)",
            library.len(),
            milliseconds[10],
            milliseconds[19]
        );
        assert!(milliseconds[10] < 100.0, "{milliseconds:?}");
    }
}
