//! The Python class `Scene`.

use crate::answer::Answer;
use crate::camera::Camera;
use crate::object::Object;
use crate::options::to_python;
use crate::texts::Texts;
use crate::{Error, fork, stage, to_py_error};
use fastlgs::query::{ObjectQuery, Pixels, selection};
use fastlgs_core::gaussians::rest_len;
use fastlgs_grid::Grid;
use fastlgs_grid::query::QueryConfig;
use glam::Vec3;
use image::RgbImage;
use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// One pixel, or several pixels of one object.
#[derive(FromPyObject)]
enum PointArgument {
    One([u32; 2]),
    Several(Vec<[u32; 2]>),
}

impl PointArgument {
    fn pixels(self) -> PyResult<Pixels> {
        let pixels = match self {
            Self::One(pixel) => vec![pixel],
            Self::Several(pixels) => pixels,
        };
        Pixels::new(pixels.into_iter().map(|[x, y]| (x, y)).collect()).map_err(Error::new_err)
    }
}

/// A trained scene folder, opened on a device.
#[pyclass(frozen, module = "fastlgs")]
pub struct Scene {
    /// The opened scene, until it is closed.
    opened: Mutex<Option<Opened>>,
    path: PathBuf,
    /// Device that was asked for; stages that open the scene again use it too.
    device: String,
}

/// The scene and its object table.
struct Opened {
    scene: fastlgs::Scene,
    grid: Arc<Grid>,
}

/// The view of a query or picture.
#[derive(Clone)]
enum ViewArgument {
    First,
    Named(String),
    Given(Box<Camera>),
}

impl ViewArgument {
    /// Reads the name of a view or a `Camera`; `None` means the first view.
    fn of(view: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let Some(view) = view else {
            return Ok(Self::First);
        };
        if let Ok(camera) = view.cast::<Camera>() {
            return Ok(Self::Given(Box::new(camera.get().clone())));
        }
        view.extract()
            .map(Self::Named)
            .map_err(|_| Error::new_err("view must be the name of a photo, or a Camera"))
    }
}

impl Scene {
    /// Runs `work` on the scene with the GIL released.
    ///
    /// The GIL must not be held while waiting for the scene: the thread that holds the scene may
    /// wait for the GIL.
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Opened) -> fastlgs::Result<T> + Send,
    ) -> PyResult<T> {
        fork::check()?;
        let with_opened = || {
            let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
            let closed =
                || fastlgs::Error::Invalid("the scene is closed; open it again".to_owned());
            work(opened.as_mut().ok_or_else(closed)?)
        };
        py.detach(with_opened).map_err(to_py_error)
    }
}

impl Scene {
    /// Runs a stage on the scene folder, with the device of the scene and seed 0.
    fn run_stage<'py, C: Serialize + DeserializeOwned + Send, R: Serialize + Send>(
        &self,
        py: Python<'py>,
        known: &C,
        options: Option<&Bound<'py, PyDict>>,
        progress: Option<Py<PyAny>>,
        stage: fn(&C, &fastlgs::Run) -> fastlgs::Result<R>,
    ) -> PyResult<Bound<'py, PyAny>> {
        stage::with_options(py, known, options, progress, &self.device, 0, stage)
    }
}

impl Opened {
    fn camera(&self, which: &ViewArgument) -> fastlgs::Result<fastlgs_core::Camera> {
        let cameras = &self.scene.cameras();
        Ok(match which {
            ViewArgument::Given(camera) => camera.to_scene(&self.scene.manifest().frame),
            ViewArgument::Named(name) => {
                cameras[self.scene.folder().view_index(cameras, name)?].clone()
            }
            ViewArgument::First => {
                let first = cameras.first().cloned();
                first.ok_or_else(|| fastlgs::Error::Invalid("the scene has no views".to_owned()))?
            }
        })
    }
}

/// Returns three planes as pixels with three values.
fn interleaved(planes: &[f32]) -> Vec<f32> {
    let pixels = planes.len() / 3;
    (0..pixels)
        .flat_map(|p| [planes[p], planes[pixels + p], planes[2 * pixels + p]])
        .collect()
}

/// Converts values in row-major order to a NumPy array of this shape.
fn to_numpy<'py, T: numpy::Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_vec(py, values)
        .reshape(shape.to_vec())?
        .into_any())
}

#[pymethods]
impl Scene {
    /// Opens a trained scene folder. `embed_text` replaces the text encoder: a function from a list
    /// of str to float32 (texts, numbers).
    #[new]
    #[pyo3(signature = (path, *, device = "auto", clip_text = None, embed_text = None))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        device: &str,
        clip_text: Option<PathBuf>,
        embed_text: Option<Py<PyAny>>,
    ) -> PyResult<Self> {
        fork::check()?;
        let open = || -> fastlgs::Result<Opened> {
            let mut scene = fastlgs::Scene::open(&path, device)?;
            scene.set_clip_text(clip_text);
            if let Some(embed) = embed_text {
                scene.use_text_encoder(Box::new(Texts(embed)))?;
            }
            let grid = scene.grid()?;
            Ok(Opened { scene, grid })
        };
        let opened = py.detach(open).map_err(to_py_error)?;
        Ok(Self {
            path: opened.scene.folder().root.clone(),
            opened: Mutex::new(Some(opened)),
            device: device.to_owned(),
        })
    }

    /// Frees the device and the memory of the scene. Later calls raise `Error`.
    fn close(&self, py: Python<'_>) {
        py.detach(|| {
            drop(
                self.opened
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .take(),
            )
        });
    }

    fn __enter__(this: Py<Self>) -> Py<Self> {
        this
    }

    fn __exit__(
        &self,
        py: Python<'_>,
        _kind: &Bound<'_, PyAny>,
        _value: &Bound<'_, PyAny>,
        _traceback: &Bound<'_, PyAny>,
    ) {
        self.close(py);
    }

    /// The scene folder.
    #[getter]
    fn path(&self) -> PathBuf {
        self.path.clone()
    }

    /// Name of the device.
    #[getter]
    fn device(&self, py: Python<'_>) -> PyResult<String> {
        self.with(py, |opened| Ok(opened.scene.adapter()))
    }

    /// Names of all views, sorted.
    #[getter]
    fn views(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.with(py, |opened| {
            Ok(opened
                .scene
                .cameras()
                .iter()
                .map(|c| c.name.clone())
                .collect())
        })
    }

    /// Names of the held-out views.
    #[getter]
    fn held_out(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.with(py, |Opened { scene, .. }| {
            Ok(scene
                .manifest()
                .held_out(scene.cameras())
                .into_iter()
                .map(|c| c.name)
                .collect())
        })
    }

    /// Returns the camera of a view.
    fn camera(&self, py: Python<'_>, view: &Bound<'_, PyAny>) -> PyResult<Camera> {
        let which = ViewArgument::of(Some(view))?;
        self.with(py, |opened| {
            Ok(Camera::from_scene(
                opened.camera(&which)?,
                &opened.scene.manifest().frame,
            ))
        })
    }

    /// Finds objects by a text, by pixels of the view, by a picture, or by the id of an object.
    ///
    /// `point` is one pixel (x, y), or a list of pixels of one object. `image` is uint8 (height,
    /// width, 3).
    #[pyo3(signature = (text = None, *, view = None, point = None, image = None, object = None, negatives = Vec::new(), false_alarms = None, top_k = None))]
    fn query(
        &self,
        py: Python<'_>,
        text: Option<String>,
        view: Option<&Bound<'_, PyAny>>,
        point: Option<PointArgument>,
        image: Option<PyReadonlyArray3<'_, u8>>,
        object: Option<u16>,
        negatives: Vec<String>,
        false_alarms: Option<f32>,
        top_k: Option<usize>,
    ) -> PyResult<Answer> {
        let ask = match (text, point, image, object) {
            (Some(text), None, None, None) => ObjectQuery::Text(text),
            (None, Some(point), None, None) => ObjectQuery::Point(point.pixels()?),
            (None, None, None, Some(id)) => ObjectQuery::Object(id),
            (None, None, Some(image), None) => {
                ObjectQuery::Image("image".to_owned(), picture(&image)?)
            }
            _ => {
                return Err(Error::new_err(
                    "query in one way: give a text, a point, an image or an object",
                ));
            }
        };
        let usual = QueryConfig::default();
        let config = QueryConfig {
            false_alarms: false_alarms.unwrap_or(usual.false_alarms),
            top_k: top_k.unwrap_or(usual.top_k),
        };
        if !(0.0..=1.0).contains(&config.false_alarms) || config.top_k == 0 {
            return Err(Error::new_err(
                "false_alarms must be a number from 0 to 1, and top_k at least 1",
            ));
        }
        let which = ViewArgument::of(view)?;
        let (camera, report, mask, relevancy) = self.with(py, |opened| {
            let camera = opened.camera(&which)?;
            let answer = opened
                .scene
                .query(ask)
                .camera(&camera)
                .negatives(&negatives)
                .false_alarms(config.false_alarms)
                .top_k(config.top_k)
                .run()?;
            let relevancy = answer.relevancy();
            Ok((camera, answer.report, answer.mask, relevancy))
        })?;
        let shape = [camera.height as usize, camera.width as usize];
        let mask = PyArray1::from_vec(py, mask).reshape(shape)?.unbind();
        let relevancy: Py<PyArray2<f32>> =
            PyArray1::from_vec(py, relevancy).reshape(shape)?.unbind();
        Ok(Answer {
            report,
            mask,
            relevancy,
        })
    }

    /// All objects and parts.
    #[getter]
    fn objects(&self, py: Python<'_>) -> PyResult<Vec<Object>> {
        self.with(py, |opened| {
            Ok(opened.grid.objects.iter().map(Object::from).collect())
        })
    }

    /// Lists all objects and parts with their likeliest names, the largest first, as `fastlgs objects
    /// --json` prints them.
    #[pyo3(signature = (names = 3))]
    fn list_objects<'py>(&self, py: Python<'py>, names: usize) -> PyResult<Bound<'py, PyAny>> {
        let listed = self.with(py, |opened| {
            fastlgs::listing::list_objects(&mut opened.scene, names)
        })?;
        to_python(py, &listed)
    }

    /// Returns the embeddings of an object's masks, (masks, numbers).
    fn embeddings<'py>(&self, py: Python<'py>, id: u16) -> PyResult<Bound<'py, PyAny>> {
        let embeddings = self.with(py, |opened| {
            let known = opened.grid.objects.len();
            let object = usize::from(id)
                .checked_sub(1)
                .and_then(|k| opened.grid.objects.get(k));
            let unknown = || {
                fastlgs::Error::NotFound(format!(
                    "there is no object {id}; the scene has {known} objects"
                ))
            };
            Ok(object.ok_or_else(unknown)?.embeddings.clone())
        })?;
        let columns = embeddings.first().map_or(0, Vec::len);
        to_numpy(py, embeddings.concat(), &[embeddings.len(), columns])
    }

    /// Renders a view: `color` uint8 (h, w, 3), `depth` float32 (h, w) in world units, `feature`
    /// float32 (h, w, 3), or `objects` uint16 (h, w).
    #[pyo3(signature = (view = None, what = "color"))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        view: Option<&Bound<'py, PyAny>>,
        what: &str,
    ) -> PyResult<Bound<'py, PyAny>> {
        let which = ViewArgument::of(view)?;
        let size = |camera: &fastlgs_core::Camera| [camera.height as usize, camera.width as usize];
        let planes = |color: bool| {
            self.with(py, |opened| {
                let camera = opened.camera(&which)?;
                let scene = &mut opened.scene;
                Ok(if color {
                    (size(&camera), interleaved(scene.render(&camera)?.color()))
                } else {
                    let frame = scene.render_feature(&camera)?;
                    (size(&camera), interleaved(frame.feature()))
                })
            })
        };
        match what {
            "color" => {
                let ([h, w], values) = planes(true)?;
                let bytes: Vec<u8> = values
                    .into_iter()
                    .map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
                    .collect();
                to_numpy(py, bytes, &[h, w, 3])
            }
            "feature" => {
                let ([h, w], values) = planes(false)?;
                to_numpy(py, values, &[h, w, 3])
            }
            "depth" => {
                let (size, values) = self.with(py, |opened| {
                    let camera = opened.camera(&which)?;
                    let unit = opened.scene.manifest().frame.scale as f32;
                    let mut depths = opened.scene.render_depth(&camera)?;
                    depths.iter_mut().for_each(|depth| *depth *= unit);
                    Ok((size(&camera), depths))
                })?;
                to_numpy(py, values, &size)
            }
            "objects" => {
                let (size, owners) = self.with(py, |opened| {
                    let camera = opened.camera(&which)?;
                    let field = opened.scene.field(&camera, None)?;
                    Ok((size(&camera), field.owners(&opened.grid).labels))
                })?;
                to_numpy(py, owners, &size)
            }
            other => Err(Error::new_err(format!(
                "what: '{other}' is unknown; use color, depth, feature or objects"
            ))),
        }
    }

    /// Objects of each value of the Gaussians' object_ids, 0 included, from small to large.
    #[getter]
    fn object_lists(&self, py: Python<'_>) -> PyResult<Vec<Vec<u16>>> {
        self.with(py, |opened| Ok(opened.grid.lists()))
    }

    /// All Gaussians as arrays: means and scales (n, 3), rotations (n, 4), opacities (n), sh (n, k,
    /// 3), features (n, 3) and object_ids (n).
    ///
    /// Means and scales are in world units, rotations are (w, x, y, z), and object_ids are indices
    /// into object_lists.
    #[getter]
    fn gaussians<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (mut scene, frame) = self.with(py, |opened| {
            Ok((
                opened.scene.gaussians().clone(),
                opened.scene.manifest().frame,
            ))
        })?;
        let n = scene.len();
        if frame.scale != 1.0 {
            scene
                .log_scales
                .iter_mut()
                .for_each(|s| *s += frame.scale.ln() as f32);
        }
        let rows =
            |values: &[Vec3]| -> Vec<f32> { values.iter().flat_map(|v| v.to_array()).collect() };
        let scales: Vec<f32> = scene
            .log_scales
            .iter()
            .flat_map(|s| s.exp().to_array())
            .collect();
        let unit = |q: &[f32; 4]| {
            let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
            q.map(|v| v / length)
        };
        let rest = rest_len(scene.sh_degree);
        let sh = (0..n).flat_map(|i| {
            std::iter::once(scene.sh_dc[i])
                .chain(scene.sh_rest[i * rest..(i + 1) * rest].iter().copied())
        });
        let opacities: Vec<f32> = scene
            .opacity_logits
            .iter()
            .map(|o| 1.0 / (1.0 + (-o).exp()))
            .collect();
        let rotations: Vec<f32> = scene.rotations.iter().flat_map(unit).collect();
        let sh: Vec<f32> = sh.flat_map(|c| c.to_array()).collect();
        let arrays = PyDict::new(py);
        // Double precision: single precision would lose digits far from the origin.
        let means = if frame.is_identity() {
            to_numpy(py, rows(&scene.means), &[n, 3])?
        } else {
            let in_world = |mean: &Vec3| frame.to_world(*mean).to_array();
            let means: Vec<f64> = scene.means.iter().flat_map(in_world).collect();
            to_numpy(py, means, &[n, 3])?
        };
        arrays.set_item("means", means)?;
        arrays.set_item("scales", to_numpy(py, scales, &[n, 3])?)?;
        arrays.set_item("rotations", to_numpy(py, rotations, &[n, 4])?)?;
        arrays.set_item("opacities", to_numpy(py, opacities, &[n])?)?;
        arrays.set_item("sh", to_numpy(py, sh, &[n, 1 + rest, 3])?)?;
        arrays.set_item("features", to_numpy(py, rows(&scene.features), &[n, 3])?)?;
        arrays.set_item("object_ids", to_numpy(py, scene.object_ids, &[n])?)?;
        Ok(arrays)
    }

    /// Returns the indices of the Gaussians of objects and their parts: uint32, ascending.
    fn select<'py>(&self, py: Python<'py>, ids: Vec<u16>) -> PyResult<Bound<'py, PyArray1<u32>>> {
        let places = self.with(py, |opened| {
            Ok(selection::gaussians(
                opened.scene.gaussians(),
                &opened.grid,
                &ids,
            ))
        })?;
        Ok(PyArray1::from_vec(
            py,
            places.into_iter().map(|place| place as u32).collect(),
        ))
    }

    /// Writes the Gaussians of objects, or with `rest` all others, as .ply, .spz, .sog or .glb.
    /// Without `ids`, writes all Gaussians.
    #[pyo3(signature = (path, ids = None, *, rest = false))]
    fn export(
        &self,
        py: Python<'_>,
        path: PathBuf,
        ids: Option<Vec<u16>>,
        rest: bool,
    ) -> PyResult<()> {
        if rest && ids.is_none() {
            return Err(Error::new_err("rest needs ids: the objects to leave out"));
        }
        self.with(py, |Opened { scene, grid }| {
            let gaussians = scene.gaussians();
            let world = selection::World::of(scene.manifest(), scene.cameras());
            let Some(ids) = &ids else {
                return selection::write(&path, gaussians, &world);
            };
            let selected = selection::gaussians(gaussians, grid, ids);
            selection::export(&path, gaussians, &world, &selected, !rest)
        })
    }

    /// Removes an object, by a text or its id, fills the gap, and writes a new scene folder.
    #[pyo3(signature = (output, text = None, *, object = None, progress = None, **options))]
    fn remove<'py>(
        &self,
        py: Python<'py>,
        output: PathBuf,
        text: Option<String>,
        object: Option<u16>,
        progress: Option<Py<PyAny>>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        if text.is_some() == object.is_some() {
            return Err(Error::new_err(
                "name the object in one way: by a text or by its id",
            ));
        }
        let known = fastlgs::RemoveConfig {
            scene: self.path.clone(),
            output,
            text,
            object,
            ..Default::default()
        };
        self.run_stage(py, &known, options, progress, fastlgs::remove)
    }

    /// Measures colour, and with a folder of labels the masks of queries, on held-out views.
    #[pyo3(signature = (labels = None, *, progress = None, **options))]
    fn evaluate<'py>(
        &self,
        py: Python<'py>,
        labels: Option<PathBuf>,
        progress: Option<Py<PyAny>>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let known = fastlgs::EvalConfig {
            scene: self.path.clone(),
            labels,
            ..Default::default()
        };
        self.run_stage(py, &known, options, progress, fastlgs::eval)
    }

    /// Teaches a name by an example: an object id, pixels of a view, or a picture file. Later
    /// queries find it, in all scenes with the same encoder.
    #[pyo3(signature = (name, *, object = None, point = None, view = None, image = None))]
    fn teach<'py>(
        &self,
        py: Python<'py>,
        name: String,
        object: Option<u16>,
        point: Option<PointArgument>,
        view: Option<String>,
        image: Option<PathBuf>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let lesson = fastlgs::teach::TeachConfig {
            name,
            scene: self.path.clone(),
            point: point.map(PointArgument::pixels).transpose()?,
            view,
            object,
            image,
        };
        let taught = self.with(py, |opened| {
            let taught = fastlgs::teach::teach_in(&mut opened.scene, &lesson)?;
            opened.scene.drop_texts();
            Ok(taught)
        })?;
        to_python(py, &taught)
    }

    /// Lists the taught names: name, examples, views and from.
    fn names<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let names = fastlgs::names::Names::load().map_err(to_py_error)?;
        to_python(py, &names.rows())
    }

    /// Removes a taught name and its examples.
    fn forget(&self, py: Python<'_>, name: &str) -> PyResult<()> {
        self.with(py, |opened| {
            fastlgs::names::Names::change(|names| names.remove(name))?;
            opened.scene.drop_texts();
            Ok(())
        })
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        self.with(py, |Opened { scene, grid, .. }| {
            let root = scene.folder().root.display();
            Ok(format!(
                "Scene('{root}', {} Gaussians, {} objects)",
                scene.gaussians().len(),
                grid.objects.len()
            ))
        })
    }
}

/// Converts a NumPy array, uint8 (height, width, 3), to a picture.
fn picture(image: &PyReadonlyArray3<'_, u8>) -> PyResult<RgbImage> {
    let view = image.as_array();
    let (height, width, channels) = view.dim();
    if channels != 3 || width == 0 || height == 0 {
        return Err(Error::new_err(format!(
            "a picture must be uint8 of shape (height, width, 3), not ({height}, {width}, {channels})"
        )));
    }
    Ok(RgbImage::from_fn(width as u32, height as u32, |x, y| {
        image::Rgb(std::array::from_fn(|k| view[(y as usize, x as usize, k)]))
    }))
}
