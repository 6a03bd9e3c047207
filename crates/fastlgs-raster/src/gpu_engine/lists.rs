//! Tile lists of a frame: projection, depth order, (tile, Gaussian) pairs, and the order of the
//! tiles.

use super::kernels::{GROUP, Kernels, Kind};
use super::pages::Gaussians;
use super::sorting::Sort;
use crate::engine::{Memory, tile_bits};
use crate::pass::Recorder;
use crate::shader::shaders::{
    EmitBuffers, GatherCountsBuffers, ProjectBuffers, TileLoadBuffers, TileRangesBuffers,
};
use crate::view::View;
use crate::{Error, Gpu, Result};
use std::collections::HashMap;
use wgpu::Buffer;

/// Total size in bytes from which no further tile lists are cached for feature training.
const CACHE_LIMIT: u64 = 1 << 30;

/// Tile lists that blending reads. Buffers are handles, so clones are cheap.
#[derive(Clone)]
pub struct Lists {
    pub view: View,
    pub order: Buffer,
    pub touched: Buffer,
    pub first_pair: Buffer,
    pub ranges: Buffer,
    pub tile_order: Buffer,
    pub sorted_pairs: Buffer,
    pub pair_gaussians: Buffer,
}

impl Lists {
    fn bytes(&self) -> u64 {
        let own = [
            &self.order,
            &self.touched,
            &self.first_pair,
            &self.ranges,
            &self.tile_order,
            &self.sorted_pairs,
            &self.pair_gaussians,
        ];
        own.iter().map(|b| b.size()).sum()
    }
}

/// Buffers with one item for each tile.
struct Tiles {
    size: [u32; 2],
    ranges: Buffer,
    sort: Sort,
}

/// Buffers with one item for each (tile, Gaussian) pair.
struct Pairs {
    capacity: usize,
    gaussians: Buffer,
    sort: Sort,
}

/// Builds tile lists, and caches those of views with frozen geometry.
#[derive(Default)]
pub struct ListBuilder {
    tiles: Option<Tiles>,
    pairs: Option<Pairs>,
    frozen: HashMap<usize, Lists>,
}

impl ListBuilder {
    /// Drops all cached lists, because the Gaussians have changed.
    pub fn clear_cache(&mut self) {
        self.frozen.clear();
    }

    /// Drops the cached lists of a view, because its target has changed.
    pub fn forget_view(&mut self, id: usize) {
        self.frozen.remove(&id);
    }

    /// Runs projection and sorting. Returns the tile lists.
    pub fn lists(
        &mut self,
        gpu: &Gpu,
        kernels: &Kernels,
        g: &Gaussians,
        view: View,
        kind: Kind,
        on_cpu: &mut usize,
    ) -> Result<Lists> {
        self.prepare_tiles(gpu, &view)?;
        let (view, order) = count_pairs(gpu, kernels, g, view, kind, on_cpu)?;
        self.prepare_pairs(gpu, view.pairs as usize)?;
        let pairs = self.pairs.as_ref().expect("prepared");
        let tiles = self.tiles.as_ref().expect("prepared");
        let mut r = Recorder::new(gpu, *on_cpu);
        let sorted = record_pairs(gpu, kernels, &mut r, g, &view, order, pairs)?;
        let ranges = &tiles.ranges;
        r.clear(ranges);
        let sorted_tiles = &pairs.sort.keys[sorted];
        let buffers = TileRangesBuffers {
            sorted_tiles,
            ranges,
        };
        let groups = view.pairs.div_ceil(GROUP);
        r.run(&kernels.listing.tile_ranges, &view, buffers, groups)?;
        let keys = &tiles.sort.keys[0];
        let buffers = TileLoadBuffers { ranges, keys };
        let tile_count = view.tile_count();
        let groups = tile_count.div_ceil(GROUP);
        r.run(&kernels.listing.tile_load, &view, buffers, groups)?;
        let ordered = tiles
            .sort
            .record(gpu, &kernels.sorting, &mut r, tile_count, 8)?;
        *on_cpu = r.submit();
        Ok(Lists {
            view,
            order: order.clone(),
            touched: g.touched.clone(),
            first_pair: g.first_pair.clone(),
            ranges: ranges.clone(),
            tile_order: tiles.sort.values[ordered].clone(),
            sorted_pairs: pairs.sort.values[sorted].clone(),
            pair_gaussians: pairs.gaussians.clone(),
        })
    }

    /// Returns the lists of a view with frozen geometry. They are built once and cached until the
    /// target of the view changes.
    pub fn frozen(
        &mut self,
        gpu: &Gpu,
        kernels: &Kernels,
        g: &Gaussians,
        view: View,
        kind: Kind,
        id: usize,
        on_cpu: &mut usize,
    ) -> Result<Lists> {
        let known = self
            .frozen
            .get(&id)
            .filter(|l| same_camera(&l.view, &view))
            .cloned();
        if let Some(lists) = known {
            let mut r = Recorder::new(gpu, *on_cpu);
            project(kernels, &mut r, g, &view, kind)?;
            *on_cpu = r.submit();
            return Ok(lists);
        }
        let lists = self.lists(gpu, kernels, g, view, kind, on_cpu)?;
        if self.frozen.values().map(Lists::bytes).sum::<u64>() < CACHE_LIMIT {
            let (pairs, n, tiles) = (
                lists.view.pairs,
                lists.view.gaussians,
                lists.view.tile_count(),
            );
            let mut r = Recorder::new(gpu, 0);
            let mut keep = |from: &Buffer, words: u32| -> Result<Buffer> {
                let to = gpu.storage("a view's lists", 4 * u64::from(words))?;
                r.copy(from, &to);
                Ok(to)
            };
            let kept = Lists {
                view: lists.view,
                order: keep(&lists.order, n)?,
                touched: keep(&lists.touched, n)?,
                first_pair: keep(&lists.first_pair, n)?,
                ranges: keep(&lists.ranges, 2 * tiles)?,
                tile_order: keep(&lists.tile_order, tiles)?,
                sorted_pairs: keep(&lists.sorted_pairs, pairs)?,
                pair_gaussians: keep(&lists.pair_gaussians, pairs)?,
            };
            r.submit();
            self.frozen.insert(id, kept);
        }
        Ok(lists)
    }

    fn prepare_tiles(&mut self, gpu: &Gpu, view: &View) -> Result<()> {
        if self.tiles.as_ref().is_none_or(|t| t.size != view.size) {
            let tiles = view.tile_count();
            let ranges = gpu.storage("tile ranges", 8 * u64::from(tiles))?;
            self.tiles = Some(Tiles {
                size: view.size,
                ranges,
                sort: Sort::new(gpu, "tile order", tiles as usize)?,
            });
        }
        Ok(())
    }

    /// Makes room for `pairs` pairs, with a quarter to spare so that reallocations are rare.
    fn prepare_pairs(&mut self, gpu: &Gpu, pairs: usize) -> Result<()> {
        if self.pairs.as_ref().is_none_or(|p| p.capacity < pairs) {
            let most = (gpu.max_binding / 4) as usize;
            let capacity = (pairs + pairs / 4 + 1024).min(most.max(pairs));
            self.pairs = None;
            let gaussians = gpu.storage("the tile list", 4 * capacity as u64)?;
            let sort = Sort::new(gpu, "the tile list", capacity)?;
            self.pairs = Some(Pairs {
                capacity,
                gaussians,
                sort,
            });
        }
        Ok(())
    }

    /// Adds its bytes to `memory`.
    pub fn count(&self, memory: &mut Memory) {
        memory.lists += self
            .pairs
            .as_ref()
            .map_or(0, |p| p.gaussians.size() + p.sort.bytes());
        memory.frame += self
            .tiles
            .as_ref()
            .map_or(0, |t| t.ranges.size() + t.sort.bytes());
        memory.views += self.frozen.values().map(Lists::bytes).sum::<u64>();
    }
}

/// Projects the Gaussians, sorts them by depth and counts their pairs. Returns the view with the
/// number of pairs, and the order of the Gaussians. Pairs are counted before any is written, so
/// that no list can overflow.
fn count_pairs<'a>(
    gpu: &Gpu,
    kernels: &Kernels,
    g: &'a Gaussians,
    view: View,
    kind: Kind,
    on_cpu: &mut usize,
) -> Result<(View, &'a Buffer)> {
    let n = g.n as u32;
    let mut r = Recorder::new(gpu, *on_cpu);
    project(kernels, &mut r, g, &view, kind)?;
    let side = g.sort.record(gpu, &kernels.sorting, &mut r, n, 24)?;
    let order = &g.sort.values[side];
    let buffers = GatherCountsBuffers {
        order,
        touched: &g.touched,
        offsets: &g.offsets,
    };
    let groups = n.div_ceil(GROUP);
    r.run(&kernels.listing.gather_counts, &view, buffers, groups)?;
    g.scan
        .record(gpu, &kernels.sorting, &mut r, &g.offsets, n)?;
    *on_cpu = r.submit();
    let pairs = g.scan.total(gpu, n)?;
    if pairs == u32::MAX {
        let reason = "more than 4 billion (tile, Gaussian) pairs: some Gaussians are too large; remove them, or lower the option size";
        return Err(Error::TooLarge(reason.to_owned()));
    }
    Ok((View { pairs, ..view }, order))
}

/// Records writing the pairs and sorting them by tile. Returns which of the two buffers of the sort
/// holds the result.
fn record_pairs(
    gpu: &Gpu,
    kernels: &Kernels,
    r: &mut Recorder,
    g: &Gaussians,
    view: &View,
    order: &Buffer,
    pairs: &Pairs,
) -> Result<usize> {
    let buffers = EmitBuffers {
        order,
        offsets: &g.offsets,
        footprints: &g.footprints,
        touched: &g.touched,
        pair_tiles: &pairs.sort.keys[0],
        pair_gaussians: &pairs.gaussians,
        first_pair: &g.first_pair,
    };
    let groups = (g.n as u32 * gpu.shape.writers()).div_ceil(GROUP);
    r.run(&kernels.listing.emit, view, buffers, groups)?;
    pairs
        .sort
        .record(gpu, &kernels.sorting, r, view.pairs, tile_bits(view))
}

/// Records the projection of all pages.
fn project(
    kernels: &Kernels,
    r: &mut Recorder,
    g: &Gaussians,
    view: &View,
    kind: Kind,
) -> Result<()> {
    let pass = &kernels.blending(kind).project;
    for page in &g.pages {
        let view = View {
            first: page.first as u32,
            page: page.n as u32,
            ..*view
        };
        let Gaussians {
            splats,
            footprints,
            touched,
            ..
        } = g;
        let buffers = ProjectBuffers {
            params: &page.params,
            splats,
            depths: &g.sort.keys[0],
            footprints,
            touched,
        };
        r.run(pass, &view, buffers, view.page.div_ceil(GROUP))?;
    }
    Ok(())
}

/// Returns whether lists built for `a` are valid for `b`.
fn same_camera(a: &View, b: &View) -> bool {
    let key = |v: &View| {
        (
            v.world_to_camera,
            v.focal,
            v.centre,
            v.size,
            v.gaussians,
            v.antialias,
        )
    };
    key(a) == key(b)
}
