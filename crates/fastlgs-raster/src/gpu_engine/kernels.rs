//! The compiled passes.

use crate::channels::Channels;
use crate::gpu::Gpu;
use crate::pass::Typed;
use crate::shader::shaders;
use crate::view::View;
use std::collections::HashMap;

/// Workgroup size of the kernels that run over Gaussians, pairs or pixels.
pub const GROUP: u32 = 64;

/// Passes of sorting and prefix sums.
pub struct Sorting {
    pub radix_count: Typed<shaders::RadixCount>,
    pub radix_scatter: Typed<shaders::RadixScatter>,
    pub scan_chunks: Typed<shaders::ScanChunks>,
    pub scan_apply: Typed<shaders::ScanApply>,
}

/// Passes between projection and blending.
pub struct Listing {
    pub gather_counts: Typed<shaders::GatherCounts>,
    pub emit: Typed<shaders::Emit>,
    pub tile_ranges: Typed<shaders::TileRanges>,
    pub tile_load: Typed<shaders::TileLoad>,
}

/// Passes of the loss and the optimiser.
pub struct Training {
    pub ssim_rows: Typed<shaders::SsimRows>,
    pub ssim_columns: Typed<shaders::SsimColumns>,
    pub ssim_backward_rows: Typed<shaders::SsimBackwardRows>,
    pub loss_gradient: Typed<shaders::LossGradient>,
    pub adam: Typed<shaders::Adam>,
}

/// Passes that are compiled for each kind of frame.
pub struct Blending {
    pub project: Typed<shaders::Project>,
    pub blend: Typed<shaders::Blend>,
    pub blend_backward: Typed<shaders::BlendBackward>,
    pub fold_slots: Typed<shaders::FoldSlots>,
    pub project_backward: Typed<shaders::ProjectBackward>,
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
    pub blend_ids: Typed<shaders::BlendIds>,
    blending: HashMap<Kind, Blending>,
}

impl Kernels {
    /// Compiles all passes except those of `Blending`.
    pub fn new(gpu: &Gpu) -> Self {
        macro_rules! pass {
            () => {
                Typed::new(gpu, Channels::Both, false)
            };
        }
        Self {
            sorting: Sorting { radix_count: pass!(), radix_scatter: pass!(), scan_chunks: pass!(), scan_apply: pass!() },
            listing: Listing { gather_counts: pass!(), emit: pass!(), tile_ranges: pass!(), tile_load: pass!() },
            training: Training {
                ssim_rows: pass!(),
                ssim_columns: pass!(),
                ssim_backward_rows: pass!(),
                loss_gradient: pass!(),
                adam: pass!(),
            },
            blend_ids: pass!(),
            blending: HashMap::new(),
        }
    }

    /// Compiles the passes of a kind of frame, unless they exist.
    pub fn prepare(&mut self, gpu: &Gpu, kind: Kind) {
        let (channels, harmonics) = kind;
        self.blending.entry(kind).or_insert_with(|| Blending {
            project: Typed::new(gpu, channels, harmonics),
            blend: Typed::new(gpu, channels, harmonics),
            blend_backward: Typed::new(gpu, channels, harmonics),
            fold_slots: Typed::new(gpu, channels, harmonics),
            project_backward: Typed::new(gpu, channels, harmonics),
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
