//! Poses as written in files, and the conventions of the programs that write them.

use crate::world_frame::Pose;
use glam::{DMat4, DQuat, DVec3, DVec4};
use serde::{Deserialize, Serialize};

/// Direction and camera axes of the poses in a file.
///
/// OpenCV axes: x right, y down, z forward. OpenGL axes: x right, y up, z backward.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PoseConvention {
    /// Camera to world, OpenGL axes: `transforms.json` of instant-ngp and nerfstudio.
    C2wOpengl,
    /// Camera to world, OpenCV axes.
    C2wOpencv,
    /// World to camera, OpenGL axes.
    W2cOpengl,
    /// World to camera, OpenCV axes: COLMAP.
    W2cOpencv,
    /// As `W2cOpencv`, but with quaternions in the order x, y, z, w.
    W2cOpencvXyzw,
    /// As `C2wOpencv`, but with quaternions in the order x, y, z, w.
    C2wOpencvXyzw,
}

impl PoseConvention {
    /// Conventions that matrices may have. The first is the default.
    pub const OF_MATRICES: [Self; 4] = [
        Self::C2wOpengl,
        Self::C2wOpencv,
        Self::W2cOpencv,
        Self::W2cOpengl,
    ];
    /// Conventions that quaternions may have. The first is the default.
    pub const OF_QUATERNIONS: [Self; 4] = [
        Self::W2cOpencv,
        Self::W2cOpencvXyzw,
        Self::C2wOpencv,
        Self::C2wOpencvXyzw,
    ];

    /// All conventions.
    pub const ALL: [Self; 6] = [
        Self::C2wOpengl,
        Self::C2wOpencv,
        Self::W2cOpengl,
        Self::W2cOpencv,
        Self::W2cOpencvXyzw,
        Self::C2wOpencvXyzw,
    ];

    /// Returns the name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::C2wOpengl => "c2w-opengl",
            Self::C2wOpencv => "c2w-opencv",
            Self::W2cOpengl => "w2c-opengl",
            Self::W2cOpencv => "w2c-opencv",
            Self::W2cOpencvXyzw => "w2c-opencv-xyzw",
            Self::C2wOpencvXyzw => "c2w-opencv-xyzw",
        }
    }
}

/// A pose as written in a file, before a convention is applied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RawPose {
    /// A 4x4 matrix.
    Matrix(DMat4),
    /// The four numbers of a rotation quaternion in file order, and a translation.
    Quaternion([f64; 4], DVec3),
}

impl RawPose {
    /// Converts the pose to OpenCV axes, assuming that it is written in `convention`.
    pub fn to_pose(&self, convention: PoseConvention) -> Pose {
        use PoseConvention::{
            C2wOpencv, C2wOpencvXyzw, C2wOpengl, W2cOpencv, W2cOpencvXyzw, W2cOpengl,
        };
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let matrix = match *self {
            Self::Matrix(matrix) => matrix,
            Self::Quaternion([a, b, c, d], translation) => {
                let xyzw = matches!(convention, W2cOpencvXyzw | C2wOpencvXyzw);
                let rotation = if xyzw {
                    DQuat::from_xyzw(a, b, c, d)
                } else {
                    DQuat::from_xyzw(b, c, d, a)
                };
                DMat4::from_mat3_translation(
                    glam::DMat3::from_quat(rotation.normalize()),
                    translation,
                )
            }
        };
        match convention {
            C2wOpengl => Pose::CameraToWorld(matrix * flip),
            C2wOpencv | C2wOpencvXyzw => Pose::CameraToWorld(matrix),
            W2cOpengl => Pose::WorldToCamera(flip * matrix),
            W2cOpencv | W2cOpencvXyzw => Pose::WorldToCamera(matrix),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_conventions_convert_to_the_same_pose() {
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let rotation = DQuat::from_rotation_y(0.7) * DQuat::from_rotation_x(-0.4);
        let c2w = DMat4::from_rotation_translation(rotation, DVec3::new(1.0, 2.0, 3.0));
        let w2c = c2w.inverse();
        let matrices = [c2w * flip, c2w, w2c, flip * w2c];
        let quaternion = |pose: DMat4, xyzw: bool| {
            let (_, rotation, translation) = pose.to_scale_rotation_translation();
            let [x, y, z, w] = rotation.to_array();
            RawPose::Quaternion(if xyzw { [x, y, z, w] } else { [w, x, y, z] }, translation)
        };
        let quaternions = [
            quaternion(w2c, false),
            quaternion(w2c, true),
            quaternion(c2w, false),
            quaternion(c2w, true),
        ];
        let stated = PoseConvention::OF_MATRICES
            .into_iter()
            .zip(matrices.map(RawPose::Matrix));
        for (convention, stated) in
            stated.chain(PoseConvention::OF_QUATERNIONS.into_iter().zip(quaternions))
        {
            let found = match stated.to_pose(convention) {
                Pose::CameraToWorld(pose) => pose,
                Pose::WorldToCamera(pose) => pose.inverse(),
            };
            assert!(found.abs_diff_eq(c2w, 1e-12), "{}", convention.name());
        }
    }
}
