//! Property tests: round trips of file formats, identities of metrics, invariants of label maps and
//! objects.

use fastlgs_core::compact::{self, Precision};
use fastlgs_core::gaussians::rest_len;
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder, metrics, ply, sog, spz};
use fastlgs_grid::overlaps::Overlaps;
use fastlgs_grid::{Grid, codes, grid::Object};
use glam::{Quat, Vec3};
use proptest::prelude::*;
use std::path::Path;

fn vec3(reach: f32) -> impl Strategy<Value = Vec3> {
    prop::array::uniform3(-reach..reach).prop_map(Vec3::from)
}

prop_compose! {
    fn gaussian(degree: u32)(
        mean in vec3(50.0), log_scale in vec3(4.0), rotation in prop::array::uniform4(-1.0f32..1.0), opacity in -6.0f32..6.0,
        dc in vec3(1.5), rest in prop::collection::vec(vec3(0.5), rest_len(degree)), feature in prop::array::uniform3(0.0f32..1.0), id in any::<u16>(),
    ) -> (Vec3, Vec3, [f32; 4], f32, Vec3, Vec<Vec3>, Vec3, u16) {
        (mean, log_scale, rotation, opacity, dc, rest, Vec3::from(feature), id)
    }
}

fn scene() -> impl Strategy<Value = Gaussians> {
    (0u32..=3)
        .prop_flat_map(|degree| (Just(degree), prop::collection::vec(gaussian(degree), 1..12)))
        .prop_map(|(sh_degree, all)| {
            let mut scene = Gaussians {
                sh_degree,
                ..Gaussians::default()
            };
            for (mean, log_scale, rotation, opacity, dc, rest, feature, id) in all {
                // A zero quaternion has no direction.
                let rotation = if rotation.iter().map(|v| v * v).sum::<f32>() < 0.01 {
                    [1.0, 0.0, 0.0, 0.0]
                } else {
                    rotation
                };
                scene.means.push(mean);
                scene.log_scales.push(log_scale);
                scene.rotations.push(rotation);
                scene.opacity_logits.push(opacity);
                scene.sh_dc.push(dc);
                scene.sh_rest.extend(rest);
                scene.features.push(feature);
                scene.object_ids.push(id);
            }
            scene
        })
}

fn mask(pixels: usize) -> impl Strategy<Value = Vec<bool>> {
    prop::collection::vec(any::<bool>(), pixels)
}

fn map() -> impl Strategy<Value = LabelMap> {
    (1u32..9, 1u32..9).prop_flat_map(|(width, height)| {
        let labels = prop::collection::vec(
            prop_oneof![Just(0u16), 1u16..6, any::<u16>()],
            (width * height) as usize,
        );
        labels.prop_map(move |labels| LabelMap {
            width,
            height,
            labels,
        })
    })
}

/// Returns the parents of objects 1, 2, ...: a smaller id, or 0 for none.
fn tree() -> impl Strategy<Value = Vec<u16>> {
    prop::collection::vec(any::<u16>(), 1..20).prop_map(|raw| {
        raw.iter()
            .enumerate()
            .map(|(k, r)| r % (k as u16 + 1))
            .collect()
    })
}

fn grid(parents: &[u16]) -> Grid {
    let object = |(k, parent): (usize, &u16)| Object {
        id: k as u16 + 1,
        parent: *parent,
        support: 0.5,
        code: Vec3::splat(0.5),
        embeddings: Vec::new(),
        areas: Vec::new(),
        views: 3,
        detected: None,
    };
    Grid {
        objects: parents.iter().enumerate().map(object).collect(),
        ..Grid::default()
    }
}

fn round_trip<T>(write: impl FnOnce(&Path), read: impl FnOnce(&Path) -> T) -> T {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("file");
    write(&path);
    read(&path)
}

proptest! {
    #[test]
    fn ply_keeps_every_bit(scene in scene()) {
        let back = round_trip(|p| ply::write(p, &scene).expect("written"), |p| ply::read(p).expect("read"));
        prop_assert_eq!(back, scene);
    }

    #[test]
    fn compact_files_stay_within_the_quantisation_error(scene in scene()) {
        let back = round_trip(|p| compact::write(p, &scene, &Precision::default()).expect("written"), |p| compact::read(p).expect("read"));
        prop_assert_eq!(&back.object_ids, &scene.object_ids);
        // Positions have three bytes over at most 100 units. Other values have two bytes over their
        // range.
        for (a, b) in back.means.iter().zip(&scene.means) {
            prop_assert!((*a - *b).abs().max_element() <= 100.0 / (1u32 << 24) as f32 + 1e-5);
        }
        for (a, b) in back.sh_rest.iter().zip(&scene.sh_rest) {
            prop_assert!((*a - *b).abs().max_element() <= 1.0 / 65_535.0 + 1e-6);
        }
    }

    #[test]
    fn spz_files_stay_within_the_quantisation_error(scene in scene()) {
        let back = round_trip(|p| spz::write(p, &scene).expect("written"), |p| spz::read(p).expect("read"));
        prop_assert_eq!(back.len(), scene.len());
        for i in 0..scene.len() {
            prop_assert!((back.means[i] - scene.means[i]).abs().max_element() <= 1.0 / 4096.0);
            prop_assert!((back.log_scales[i] - scene.log_scales[i]).abs().max_element() <= 1.0 / 16.0);
            let turn: Quat = back.rotation(i) * scene.rotation(i).inverse();
            prop_assert!(turn.w.abs() > 0.98, "the rotation differs by {} rad", 2.0 * turn.w.abs().min(1.0).acos());
        }
    }

    #[test]
    fn sog_files_stay_within_the_quantisation_error(scene in scene()) {
        let back = round_trip(|p| sog::write(p, &scene).expect("written"), |p| sog::read(p).expect("read"));
        prop_assert_eq!(back.len(), scene.len());
        // SOG reorders the Gaussians.
        for (mean, i) in back.means.iter().zip(0..) {
            let near = |k: &usize| (*mean - scene.means[*k]).abs().max_element() <= 0.01 * (1.0 + mean.abs().max_element());
            let same = |k: &usize| (back.log_scales[i] - scene.log_scales[*k]).abs().max_element() <= 0.2 && back.rotation(i).dot(scene.rotation(*k)).abs() > 0.999;
            prop_assert!((0..scene.len()).filter(near).any(|k| same(&k)), "Gaussian {i}");
        }
    }

    #[test]
    fn label_maps_round_trip(a in map()) {
        let back = round_trip(|p| a.save(&p.with_extension("png")).expect("written"), |p| LabelMap::load(&p.with_extension("png")).expect("read"));
        prop_assert_eq!(&back.labels, &a.labels);
        let (dense, names) = a.dense();
        let undone: Vec<u16> = dense.labels.iter().map(|l| names[usize::from(*l)]).collect();
        prop_assert_eq!(&undone, &a.labels);
        prop_assert!(usize::from(dense.max()) < names.len());
    }

    #[test]
    fn metrics_of_masks_have_their_invariants(a in mask(48), b in mask(48)) {
        let iou = metrics::iou(&a, &b);
        prop_assert!((0.0..=1.0).contains(&iou));
        prop_assert_eq!(iou, metrics::iou(&b, &a));
        prop_assert_eq!(metrics::iou(&a, &a), 1.0);
        // IoU never exceeds recall, because both count the same pixels.
        prop_assert!(iou <= metrics::recall(&a, &b) + 1e-12);
        prop_assert_eq!(metrics::boundary_iou(&a, &a, 8, 6, 1), 1.0);
        // The eroded mask lies in the mask, and the mask in the dilated one.
        let (eroded, dilated) = (metrics::erode(&a, 8, 6, 1), metrics::dilate(&a, 8, 6, [1, 1]));
        prop_assert!(eroded.iter().zip(&a).all(|(e, a)| !e || *a) && a.iter().zip(&dilated).all(|(a, d)| !a || *d));
    }

    #[test]
    fn metrics_of_images_and_ranks_are_symmetric(x in prop::collection::vec(0.0f32..1.0, 192), y in prop::collection::vec(0.0f32..1.0, 192), p in prop::collection::vec(0.0f64..1.0, 1..9), n in prop::collection::vec(0.0f64..1.0, 1..9)) {
        let ssim = |a: &[f32], b: &[f32]| metrics::ssim(a, b, 16, 12, &[true; 192]);
        prop_assert!((ssim(&x, &x) - 1.0).abs() < 1e-5);
        prop_assert!((ssim(&x, &y) - ssim(&y, &x)).abs() < 1e-9);
        prop_assert_eq!(metrics::psnr(&x, &y), metrics::psnr(&y, &x));
        prop_assert_eq!(metrics::psnr(&x, &x), 100.0);
        prop_assert!((metrics::auroc(&p, &n) + metrics::auroc(&n, &p) - 1.0).abs() < 1e-9, "ties count half");
    }

    #[test]
    fn members_of_an_object_are_its_parts(parents in tree(), pick in any::<u16>()) {
        let grid = grid(&parents);
        let id = pick % parents.len() as u16 + 1;
        let chain: Vec<u16> = grid.chain(id).collect();
        prop_assert_eq!(chain[0], id);
        prop_assert!(chain.windows(2).all(|w| parents[usize::from(w[0]) - 1] == w[1]));
        let members = grid.members(&[id]);
        for other in 1..=parents.len() as u16 {
            prop_assert_eq!(members[usize::from(other)], grid.chain(other).any(|a| a == id));
        }
        prop_assert!(!members[0]);
    }

    #[test]
    fn objects_that_overlap_keep_their_lists(parents in tree(), raw in prop::collection::vec((any::<u32>(), 1u8..20), 1..40), pick in any::<u16>()) {
        let count = parents.len() as u16;
        let lists: Vec<Vec<u16>> = raw.iter().map(|(bits, _)| (1..=count).rev().filter(|id| bits >> id & 1 > 0).collect()).collect();
        let weights: Vec<f32> = raw.iter().map(|r| f32::from(r.1)).collect();
        let (overlaps, ids) = Overlaps::of(&lists, &parents, &weights, 1.0);
        let mut grid = Grid { overlaps, ..grid(&parents) };
        grid.id_areas = vec![0.0; usize::from(grid.highest()) + 1];
        ids.iter().zip(&weights).for_each(|(id, weight)| grid.id_areas[usize::from(*id)] += weight);
        for (id, list) in ids.iter().zip(&lists) {
            prop_assert_eq!(&grid.chain(*id).collect::<Vec<_>>(), list);
        }
        let dir = tempfile::tempdir().expect("a folder");
        let folder = SceneFolder::new(dir.path());
        grid.save(&folder).expect("it can be written");
        prop_assert_eq!(&Grid::load(&folder).expect("it can be read"), &grid);

        let picked_id = pick % count + 1;
        let (members, related) = (grid.members(&[picked_id]), grid.related(picked_id));
        for (id, list) in ids.iter().zip(&lists) {
            prop_assert_eq!(members[usize::from(*id)], list.contains(&picked_id));
        }
        for other in 1..=count {
            prop_assert_eq!(related[usize::from(other) - 1], grid.related(other)[usize::from(picked_id) - 1], "{} and {}", picked_id, other);
        }
        let gone = grid.parts(&[picked_id]);
        let (left, new) = grid.without(&grid.parts(&[picked_id]));
        let stay: Vec<u16> = (1..=count).filter(|id| !gone[usize::from(*id) - 1]).collect();
        for (id, list) in ids.iter().zip(&lists) {
            let after: Vec<u16> = left.chain(new[usize::from(*id)]).map(|id| stay[usize::from(id) - 1]).collect();
            prop_assert_eq!(after, list.iter().copied().filter(|id| stay.contains(id)).collect::<Vec<_>>());
        }
        prop_assert_eq!(left.id_areas.iter().sum::<f32>(), grid.id_areas.iter().sum::<f32>());
    }

    #[test]
    fn codes_keep_the_spacing_of_the_lattice(count in 1usize..400, seed in any::<u64>()) {
        let codes = codes::lattice(count, seed);
        // Spacing K^(-1/3) (paper), with the side of the lattice rounded up.
        let side = (1..).find(|s: &usize| s.pow(3) >= count).expect("a side") as f32;
        prop_assert_eq!(codes.len(), count);
        for (i, a) in codes.iter().enumerate() {
            prop_assert!(a.min_element() > 0.0 && a.max_element() < 1.0);
            prop_assert!(codes[..i].iter().all(|b| a.distance(*b) > 0.99 / side));
        }
    }

    #[test]
    fn cameras_round_trip(eye in vec3(5.0), fov in 0.2f32..2.0, size in (8u32..900, 8u32..900)) {
        prop_assume!(eye.length() > 0.5 && eye.normalize().y.abs() < 0.99);
        let camera = Camera::look_at("a.png", eye, Vec3::ZERO, Vec3::Y, size.0, size.1, fov);
        let text = serde_json::to_vec(&camera).expect("JSON");
        let back = round_trip(|p| std::fs::write(p, &text).expect("written"), |p| Camera::load(p, &fastlgs_core::WorldFrame::default()).expect("read"));
        prop_assert_eq!(&back, &camera);
        prop_assert!((camera.centre() - eye).length() < 1e-3);
        let seen = camera.to_pixel(camera.world_to_camera.transform_point3(Vec3::ZERO));
        prop_assert!((seen.x - size.0 as f32 / 2.0).abs() < 0.5 && (seen.y - size.1 as f32 / 2.0).abs() < 0.5);
    }
}
