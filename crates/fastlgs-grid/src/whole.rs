//! Global mapping, second step: regions that belong together become whole objects.
//!
//! A segmenter without learned objects cuts a thing where its colour changes. What the parts mean, averaged over all
//! views that show them, is much steadier than in a single photo: touching regions of like meaning, which the masks of
//! at least some views join, are one object.

use crate::consensus::{Regions, Seen, agreement, merged};
use std::collections::BTreeMap;

/// Likeness, 0 to 1, from which touching regions are one object.
pub const LIKENESS: f32 = 0.33;
/// Length of the mean meaning that counts as much as colour: logits of plain walls have about 14, of known things 35.
const HALF_TELLING: f32 = 20.0;
/// Colour distance (CIE Lab) at which likeness falls to 1/e.
const COLOR_RANGE: f32 = 20.0;
/// Pairs of neighbouring Gaussians that make two regions touch, as a share of the smaller one's.
const TOUCH: f32 = 0.02;

/// What a region looks like: sums over all pixels of all views that show it.
#[derive(Clone, Debug, Default)]
pub struct Look {
    /// Number of pixels.
    pub pixels: f32,
    /// CIE Lab colour.
    pub color: [f32; 3],
    /// A signed description of what is there, such as class logits without their mean.
    pub meaning: Vec<f32>,
}

struct Group {
    seen: Seen,
    look: Look,
    gaussians: u32,
    members: Vec<u16>,
}

/// Mean of the views' agreement and of how alike they look: by meaning where both mean something, else by colour.
fn likeness(a: &Group, b: &Group) -> f32 {
    let dot = |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(p, q)| p * q).sum::<f32>();
    let strength = |l: &Look| dot(&l.meaning, &l.meaning).sqrt();
    let (sa, sb) = (strength(&a.look), strength(&b.look));
    let cosine = dot(&a.look.meaning, &b.look.meaning) / (sa * sb).max(1e-12);
    let mean = |l: &Look, k: usize| l.color[k] / l.pixels.max(1.0);
    let distance = (0..3).map(|k| (mean(&a.look, k) - mean(&b.look, k)).powi(2)).sum::<f32>().sqrt();
    let telling = (sa / a.look.pixels.max(1.0)).min(sb / b.look.pixels.max(1.0)).powi(2);
    let telling = telling / (telling + HALF_TELLING * HALF_TELLING);
    let alike = telling * cosine.max(0.0) + (1.0 - telling) * (-distance / COLOR_RANGE).exp();
    0.5 * (alike + agreement(&a.seen, &b.seen))
}

/// Object of each region, 1..=K in order of falling number of Gaussians; and K.
///
/// `looks[k]` is that of region k + 1.
pub fn join(regions: &Regions, looks: Vec<Look>, least: f32) -> (Vec<u16>, u16) {
    let mut sizes = vec![0u32; looks.len() + 1];
    regions.of.iter().for_each(|r| sizes[usize::from(*r)] += 1);
    let mut groups: Vec<Option<Group>> = regions
        .seen
        .iter()
        .zip(looks)
        .enumerate()
        .map(|(k, (seen, look))| Some(Group { seen: seen.clone(), look, gaussians: sizes[k + 1], members: vec![k as u16] }))
        .collect();
    let mut contacts: BTreeMap<(usize, usize), u32> =
        regions.contacts.iter().map(|(&(a, b), n)| ((usize::from(a) - 1, usize::from(b) - 1), *n)).collect();
    let like = |groups: &[Option<Group>], (a, b): (usize, usize), n: u32| match (&groups[a], &groups[b]) {
        (Some(a), Some(b)) if n as f32 >= TOUCH * a.gaussians.min(b.gaussians) as f32 => likeness(a, b),
        _ => 0.0,
    };
    let mut scores: BTreeMap<(usize, usize), f32> = contacts.iter().map(|(pair, n)| (*pair, like(&groups, *pair, *n))).collect();
    while let Some((&(a, b), _)) = scores.iter().filter(|s| *s.1 >= least).max_by(|x, y| x.1.total_cmp(y.1).then(y.0.cmp(x.0))) {
        let Some(gone) = groups[b].take() else { break };
        if let Some(group) = &mut groups[a] {
            group.seen = merged(&group.seen, &gone.seen);
            group.look.pixels += gone.look.pixels;
            group.look.color.iter_mut().zip(gone.look.color).for_each(|(x, y)| *x += y);
            group.look.meaning.iter_mut().zip(gone.look.meaning).for_each(|(x, y)| *x += y);
            group.gaussians += gone.gaussians;
            group.members.extend(gone.members);
        }
        let touched: Vec<((usize, usize), u32)> = contacts.iter().filter(|c| c.0.0 == b || c.0.1 == b).map(|c| (*c.0, *c.1)).collect();
        for ((p, q), n) in touched {
            contacts.remove(&(p, q));
            scores.remove(&(p, q));
            let other = if p == b { q } else { p };
            if other != a {
                *contacts.entry((a.min(other), a.max(other))).or_default() += n;
            }
        }
        for (pair, n) in contacts.iter().filter(|c| c.0.0 == a || c.0.1 == a) {
            scores.insert(*pair, like(&groups, *pair, *n));
        }
    }
    let mut whole: Vec<Group> = groups.into_iter().flatten().collect();
    whole.sort_by_key(|g| (std::cmp::Reverse(g.gaussians), g.members[0]));
    let mut object = vec![0u16; regions.seen.len()];
    for (k, group) in whole.iter().enumerate() {
        group.members.iter().for_each(|m| object[usize::from(*m)] = k as u16 + 1);
    }
    (object, whole.len() as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn like_neighbours_join_and_others_do_not() {
        let seen = |label: u16| -> Seen { (0..4).map(|view| ((view, label), 10.0)).collect() };
        let regions = Regions {
            of: vec![1, 1, 2, 2, 3, 3, 4, 4],
            seen: (1..=4).map(seen).collect(),
            contacts: BTreeMap::from([((1, 2), 2), ((2, 3), 2)]),
        };
        // 1 and 2 mean the same and touch; 3 touches but means something else; 4 means the same but is elsewhere.
        let look = |meaning: [f32; 2]| Look { pixels: 10.0, color: [500.0, 0.0, 0.0], meaning: meaning.map(|m| 1000.0 * m).to_vec() };
        let looks = vec![look([1.0, 0.1]), look([1.0, 0.0]), look([0.0, 1.0]), look([1.0, 0.0])];
        let (object, count) = join(&regions, looks, 0.4);
        assert_eq!((object, count), (vec![1, 1, 2, 3], 3));
    }

    #[test]
    fn colour_decides_where_nothing_is_recognised() {
        let seen = |label: u16| -> Seen { (0..4).map(|view| ((view, label), 10.0)).collect() };
        let regions =
            Regions { of: vec![1, 2, 3], seen: (1..=3).map(seen).collect(), contacts: BTreeMap::from([((1, 2), 1), ((2, 3), 1)]) };
        let look = |lightness: f32| Look { pixels: 10.0, color: [10.0 * lightness, 0.0, 0.0], meaning: vec![1.0, 0.0] };
        let (object, _) = join(&regions, vec![look(80.0), look(78.0), look(20.0)], 0.33);
        assert!(object[0] == object[1] && object[1] != object[2], "{object:?}");
    }
}
