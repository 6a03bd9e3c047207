//! Data layer of FastLGS, without GPU, neural networks or text: cameras and posed photos, Gaussians
//! and their file formats, label maps, evaluation labels, metrics, and the scene folder that
//! connects the stages.
//!
//! Conventions of the whole project:
//! * world units are those of the input poses (see [`world_frame`] for extreme ones); cameras look
//!   along +z with x right and y down (OpenCV);
//! * pixel (0, 0) covers [0, 1) x [0, 1): its centre is at (0.5, 0.5);
//! * images are row-major; planar float images are `[channel][row][column]`.

pub mod camera;
pub mod camera_path;
pub mod color;
pub mod compact;
mod compressed_ply;
pub mod curve;
pub mod dataset;
pub mod error;
pub mod exr_image;
pub mod fs;
pub mod gaussians;
pub mod glb;
pub mod id_weights;
pub mod image_io;
pub mod label_map;
pub mod labels;
pub mod mask_image;
pub mod mask_list;
pub mod metrics;
pub mod normal_map;
pub mod npy;
pub mod ply;
pub mod rng;
pub mod scene_folder;
pub mod simd;
pub mod sog;
pub mod splat;
pub mod splat_file;
pub mod spz;
pub mod stats;
pub mod turbo;
pub mod undistort;
pub mod world_frame;

pub use camera::Camera;
pub use error::{Error, Result};
pub use gaussians::Gaussians;
pub use id_weights::IdWeights;
pub use label_map::LabelMap;
pub use mask_list::{Level, MaskList};
pub use scene_folder::SceneFolder;
pub use world_frame::WorldFrame;
