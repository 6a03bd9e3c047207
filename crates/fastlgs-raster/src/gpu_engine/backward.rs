//! The passes from the frame's gradient to those of the Gaussians, and the optimiser step.
//!
//! Gradient slots of the pairs are bound in windows, because one binding may not hold all.

use super::kernels::{Blending, GROUP, Training};
use super::lists::Lists;
use super::pages::Gaussians;
use crate::channels::Channels;
use crate::pass::Recorder;
use crate::shader::shaders::{
    AdamBuffers, BlendBackwardBuffers, FoldSlotsBuffers, ProjectBackwardBuffers,
};
use crate::view::{Step, View, stride};
use crate::{Error, Gpu, Result};
use wgpu::Buffer;

/// Buffer of gradient slots for a window of pairs.
#[derive(Default)]
pub struct Slots(Option<Buffer>);

/// First pair of a window, and the number of pairs whose Gaussians start in it.
type Window = (u32, u32);

impl Slots {
    /// Returns the size of the buffer in bytes.
    pub fn bytes(&self) -> u64 {
        self.0.as_ref().map_or(0, Buffer::size)
    }

    /// Returns a buffer for all pairs, or for as many as one binding holds, and its windows. A
    /// Gaussian that starts in a window may have up to `tile_count` pairs beyond its end, so each
    /// window leaves room for them.
    fn windows(
        &mut self,
        gpu: &Gpu,
        view: &View,
        channels: Channels,
    ) -> Result<(&Buffer, Vec<Window>)> {
        let bytes = 16 * channels.slot();
        let max_slots = (gpu.max_binding as usize / bytes).min(u32::MAX as usize / 2);
        let (pairs, spare) = (view.pairs as usize, view.tile_count() as usize);
        let window = if pairs <= max_slots {
            pairs
        } else {
            max_slots.saturating_sub(spare)
        };
        if window == 0 && pairs > 0 {
            return Err(Error::TooLarge(format!(
                "{spare} tiles are too many for '{}'; lower the option size",
                gpu.name
            )));
        }
        let needed = (bytes * pairs.min(max_slots)) as u64;
        let slots = match self.0.take().filter(|slots| slots.size() >= needed) {
            Some(slots) => slots,
            None => gpu.storage(
                "gradient slots of the tile list",
                (needed + needed / 4).min((bytes * max_slots) as u64),
            )?,
        };
        let slots = self.0.insert(slots);
        if pairs <= max_slots {
            return Ok((slots, vec![(0, u32::MAX / 2)]));
        }
        let firsts: Vec<u32> = (0..pairs)
            .step_by(window)
            .map(|first| first as u32)
            .collect();
        let last = *firsts.last().expect("there are more pairs than slots");
        let windows = firsts
            .iter()
            .map(|&f| {
                (
                    f,
                    if f == last {
                        (pairs - f as usize) as u32 + 1
                    } else {
                        window as u32
                    },
                )
            })
            .collect();
        Ok((slots, windows))
    }

    /// Records the passes that compute the gradients of all Gaussians from that of the frame.
    pub fn record(
        &mut self,
        gpu: &Gpu,
        passes: &Blending,
        r: &mut Recorder,
        channels: Channels,
        lists: &Lists,
        g: &Gaussians,
        frame: &Buffer,
        gradient: &Buffer,
    ) -> Result<()> {
        let Lists {
            view,
            order,
            touched,
            first_pair,
            ranges,
            tile_order,
            sorted_pairs,
            pair_gaussians,
        } = lists;
        let Gaussians { splats, stats, .. } = g;
        let (slots, windows) = self.windows(gpu, view, channels)?;
        for (slot_first, slot_count) in windows {
            let view = View {
                slot_first,
                slot_count,
                fold_length: gpu.shape.fold(),
                ..*view
            };
            let of_frame = BlendBackwardBuffers {
                ranges,
                tile_order,
                sorted_pairs,
                pair_gaussians,
                splats,
                frame,
                gradient,
                slots,
            };
            let groups = gpu.shape.groups(view.tile_count());
            r.run(&passes.blend_backward, &view, of_frame, groups)?;
            if view.fold_length > 1 {
                let folded = FoldSlotsBuffers {
                    touched,
                    first_pair,
                    pair_gaussians,
                    slots,
                };
                let pairs =
                    (view.pairs - slot_first).min(slot_count.saturating_add(view.tile_count()));
                let groups = pairs.div_ceil(view.fold_length).div_ceil(GROUP);
                r.run(&passes.fold_slots, &view, folded, groups)?;
            }
            for page in &g.pages {
                let view = View {
                    first: page.first as u32,
                    page: page.n as u32,
                    ..view
                };
                let of_slots = ProjectBackwardBuffers {
                    params: &page.params,
                    splats,
                    order,
                    touched,
                    first_pair,
                    slots,
                    gradients: &page.gradients,
                    stats,
                };
                let groups = view.gaussians.div_ceil(GROUP);
                r.run(&passes.project_backward, &view, of_slots, groups)?;
            }
        }
        Ok(())
    }
}

/// Records Adam on all pages.
pub fn adam(passes: &Training, r: &mut Recorder, g: &Gaussians, step: &Step) -> Result<()> {
    for page in &g.pages {
        let step = Step {
            quads: stride(page.n) as u32 / 4,
            frozen: step.frozen.saturating_sub(page.first as u32),
            ..*step
        };
        let (gradients, params, moment1, moment2) =
            (&page.gradients, &page.params, &page.moment1, &page.moment2);
        r.run(
            &passes.adam,
            &step,
            AdamBuffers {
                gradients,
                params,
                moment1,
                moment2,
            },
            step.quads.div_ceil(GROUP),
        )?;
    }
    Ok(())
}
