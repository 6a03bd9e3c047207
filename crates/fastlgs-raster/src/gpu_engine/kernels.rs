//! The compiled passes.

use crate::channels::Channels;
use crate::gpu::Gpu;
use crate::pass::TypedPass;
use crate::shader::shaders;
use crate::view::View;
use std::collections::HashMap;

/// Workgroup size of the kernels that run over Gaussians, pairs or pixels.
pub const GROUP: u32 = 64;

/// Passes of sorting and prefix sums.
pub struct Sorting {
    pub radix_count: TypedPass<shaders::RadixCount>,
    pub radix_scatter: TypedPass<shaders::RadixScatter>,
    pub scan_chunks: TypedPass<shaders::ScanChunks>,
    pub scan_apply: TypedPass<shaders::ScanApply>,
}

/// Passes between projection and blending.
pub struct Listing {
    pub gather_counts: TypedPass<shaders::GatherCounts>,
    pub emit: TypedPass<shaders::Emit>,
    pub tile_ranges: TypedPass<shaders::TileRanges>,
    pub tile_load: TypedPass<shaders::TileLoad>,
}

/// Passes of the loss and the optimiser.
pub struct Training {
    pub ssim_rows: TypedPass<shaders::SsimRows>,
    pub ssim_columns: TypedPass<shaders::SsimColumns>,
    pub ssim_backward_rows: TypedPass<shaders::SsimBackwardRows>,
    pub loss_gradient: TypedPass<shaders::LossGradient>,
    pub depth_gradient: TypedPass<shaders::DepthGradient>,
    pub adam: TypedPass<shaders::Adam>,
}

/// Passes that are compiled for each kind of frame.
pub struct Blending {
    pub project: TypedPass<shaders::Project>,
    pub blend: TypedPass<shaders::Blend>,
    pub blend_backward: TypedPass<shaders::BlendBackward>,
    pub fold_slots: TypedPass<shaders::FoldSlots>,
    pub project_backward: TypedPass<shaders::ProjectBackward>,
}

/// Kind of a frame: its channels, and whether colour depends on the view.
pub type Kind = (Channels, bool);

/// Returns the kind of a frame.
pub fn kind(view: &View, channels: Channels) -> Kind {
    (channels, view.sh_degree > 0)
}

/// All passes.
pub struct Kernels {
    pub sorting: Sorting,
    pub listing: Listing,
    pub training: Training,
    pub blend_ids: TypedPass<shaders::BlendIds>,
    pub blend_votes: TypedPass<shaders::BlendVotes>,
    pub blend_saliency: TypedPass<shaders::BlendSaliency>,
    blending: HashMap<Kind, Blending>,
}

impl Kernels {
    /// Compiles all passes except those of `Blending`.
    pub fn new(gpu: &Gpu) -> Self {
        macro_rules! pass {
            () => {
                TypedPass::new(gpu, Channels::Both, false)
            };
        }
        Self {
            sorting: Sorting {
                radix_count: pass!(),
                radix_scatter: pass!(),
                scan_chunks: pass!(),
                scan_apply: pass!(),
            },
            listing: Listing {
                gather_counts: pass!(),
                emit: pass!(),
                tile_ranges: pass!(),
                tile_load: pass!(),
            },
            training: Training {
                ssim_rows: pass!(),
                ssim_columns: pass!(),
                ssim_backward_rows: pass!(),
                loss_gradient: pass!(),
                depth_gradient: pass!(),
                adam: pass!(),
            },
            blend_ids: pass!(),
            blend_votes: pass!(),
            blend_saliency: pass!(),
            blending: HashMap::new(),
        }
    }

    /// Compiles the passes of a kind of frame, unless they exist.
    pub fn prepare(&mut self, gpu: &Gpu, kind: Kind) {
        let (channels, harmonics) = kind;
        self.blending.entry(kind).or_insert_with(|| Blending {
            project: TypedPass::new(gpu, channels, harmonics),
            blend: TypedPass::new(gpu, channels, harmonics),
            blend_backward: TypedPass::new(gpu, channels, harmonics),
            fold_slots: TypedPass::new(gpu, channels, harmonics),
            project_backward: TypedPass::new(gpu, channels, harmonics),
        });
    }

    /// Returns the passes of a kind of frame.
    ///
    /// # Panics
    /// If it was not prepared.
    pub fn blending(&self, kind: Kind) -> &Blending {
        &self.blending[&kind]
    }
}
