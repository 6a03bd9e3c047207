//! Votes of the detector for the objects of a scene: a second source of names, beside embeddings.

use crate::calibrations::OFFLINE;
use crate::{Result, Run};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, LabelMap, SceneFolder};
use fastlgs_vision::detector::{Bounds, CLASSES, Detection, box_iou};
use fastlgs_vision::{Detector, Nouns};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Votes for an object by class, 0 to 1: the mean over its views of score times IoU of the boxes.
/// Each view has the square root of the object's area as weight.
pub type Votes = BTreeMap<String, f32>;

/// Least IoU of the box of a detection with the box of an object that it votes for.
const MIN_IOU: f32 = 0.5;
/// Least number of pixels of an object in a view that counts.
const MIN_PIXELS: usize = 30;
/// Smallest vote that is stored.
const MIN_VOTE: f32 = 0.005;

/// Loads the detector for a scene. Returns `None` if it is not installed, or if the scene has
/// another encoder than the offline one, which needs no second source.
///
/// # Errors
/// A file that is damaged.
pub fn detector_of(manifest: &Manifest) -> Result<Option<Detector>> {
    let is_used = manifest.encoder == OFFLINE && Detector::is_installed() && Nouns::is_installed();
    Ok(is_used.then(Detector::load).transpose()?)
}

/// Returns the votes for each object by the object maps and photos of `folder`. `lists` holds the
/// objects of each id.
///
/// # Errors
/// A file that cannot be read, failed inference, or a cancelled run.
pub fn votes(
    folder: &SceneFolder,
    training: &[Camera],
    lists: &[Vec<u16>],
    detector: &Detector,
    run: &Run,
) -> Result<Vec<Votes>> {
    let objects = lists.iter().flatten().copied().max().unwrap_or(0);
    let work = run.work("detections", training.len() as u64);
    let of_view = |camera: &Camera| -> Result<Vec<Option<ViewVotes>>> {
        let seen = objects_in(&folder.objects(&camera.name)?, lists, objects);
        let found = detector.detect(&folder.photo(&camera.name)?)?;
        work.advance()?;
        let votes = |shown: ShownObject| ViewVotes {
            weight: shown.area.sqrt(),
            by_class: votes_for(shown.bounds, &found),
        };
        Ok(seen.into_iter().map(|shown| shown.map(votes)).collect())
    };
    let by_view = training
        .par_iter()
        .map(of_view)
        .collect::<Result<Vec<_>>>()?;
    let mean_of = |object: usize| {
        let seen: Vec<&ViewVotes> = by_view
            .iter()
            .filter_map(|view| view[object].as_ref())
            .collect();
        let total: f32 = seen.iter().map(|votes| votes.weight).sum();
        let mean = |class: usize| {
            let weighted = seen
                .iter()
                .map(|votes| votes.weight * votes.by_class[class]);
            weighted.sum::<f32>() / total.max(f32::MIN_POSITIVE)
        };
        let all = CLASSES.iter().enumerate();
        all.map(|(class, name)| ((*name).to_owned(), mean(class)))
            .filter(|(_, vote)| *vote >= MIN_VOTE)
            .collect()
    };
    Ok((0..usize::from(objects)).map(mean_of).collect())
}

/// Votes of one view for an object.
struct ViewVotes {
    weight: f32,
    /// The largest vote for each class.
    by_class: Vec<f32>,
}

/// An object in a view.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ShownObject {
    bounds: Bounds,
    /// Share of the view's area.
    area: f32,
}

/// Returns the largest vote of a view for each class.
fn votes_for(bounds: Bounds, found: &[Detection]) -> Vec<f32> {
    let mut votes = vec![0.0f32; CLASSES.len()];
    for detection in found {
        let iou = box_iou(bounds, detection.bounds);
        if iou >= MIN_IOU {
            votes[detection.class] = votes[detection.class].max(detection.score * iou);
        }
    }
    votes
}

/// Returns each object of a view; `None` for one with too few pixels.
fn objects_in(map: &LabelMap, lists: &[Vec<u16>], objects: u16) -> Vec<Option<ShownObject>> {
    let areas = map.areas();
    let mut found: Vec<Option<([u32; 4], usize)>> = vec![None; usize::from(objects)];
    for (id, bounds) in map.boxes().into_iter().enumerate() {
        let (Some(own), Some(list)) = (bounds, lists.get(id)) else {
            continue;
        };
        for object in list {
            let (all, pixels) = found[usize::from(*object) - 1].get_or_insert((own, 0));
            let [left, top, right, bottom] = *all;
            *all = [
                left.min(own[0]),
                top.min(own[1]),
                right.max(own[2]),
                bottom.max(own[3]),
            ];
            *pixels += areas[id];
        }
    }
    let size = [map.width, map.height].map(|n| n as f32);
    let shown = |(bounds, pixels): ([u32; 4], usize)| ShownObject {
        bounds: std::array::from_fn(|k| bounds[k] as f32 / size[k % 2]),
        area: pixels as f32 / (size[0] * size[1]),
    };
    let is_seen = |found: &([u32; 4], usize)| found.1 >= MIN_PIXELS;
    found
        .into_iter()
        .map(|found| found.filter(is_seen).map(shown))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_has_the_box_of_its_parts_and_the_votes_of_boxes_that_fit() {
        // Ids 1 and 2 are parts of object 3; object 4 has one pixel.
        let labels = (0..400u32).map(|p| match (p % 20, p / 20) {
            (0..5, 0..10) => 1,
            (5..10, 0..10) => 2,
            (19, 19) => 4,
            _ => 0,
        });
        let map = LabelMap {
            width: 20,
            height: 20,
            labels: labels.collect(),
        };
        let lists = [vec![], vec![1, 3], vec![2, 3], vec![3], vec![4]];
        let shown = |bounds: Bounds, area: f32| Some(ShownObject { bounds, area });
        assert_eq!(
            objects_in(&map, &lists, 4),
            [
                shown([0.0, 0.0, 0.25, 0.5], 0.125),
                shown([0.25, 0.0, 0.5, 0.5], 0.125),
                shown([0.0, 0.0, 0.5, 0.5], 0.25),
                None
            ]
        );
        let found = [
            Detection {
                class: 7,
                score: 0.8,
                bounds: [0.0, 0.0, 0.5, 0.5],
            },
            Detection {
                class: 7,
                score: 0.6,
                bounds: [0.0, 0.0, 0.5, 0.4],
            },
            Detection {
                class: 9,
                score: 0.9,
                bounds: [0.0, 0.0, 1.0, 1.0],
            },
        ];
        let votes = votes_for([0.0, 0.0, 0.5, 0.5], &found);
        assert!((votes[7] - 0.8).abs() < 1e-6 && votes[9] == 0.0);
        assert!((votes_for([0.0, 0.0, 0.25, 0.5], &found)[7] - 0.4).abs() < 1e-6);
    }
}
