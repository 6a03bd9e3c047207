//! Maps masks of several photos to objects with Algorithm 1 of the paper: by common key points,
//! then by embedding and colour.
//!
//! `cargo run --release -p fastlgs-grid --example map_masks`

use fastlgs_grid::codes;
use fastlgs_grid::grid::Grid;
use fastlgs_grid::mapping::{Correspondences, Mask, PaperConfig, paper};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Three photos of a mug and a book. The book has turned so far in the last photo that only key
    // points match it.
    let mask = |view, label, embedding: [f32; 3], red: f32| Mask {
        view,
        label,
        area: 0.1,
        embedding: embedding.to_vec(),
        histogram: vec![red, 1.0 - red],
    };
    let (mug, book, spine) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.6, 0.8]);
    let masks = [
        mask(0, 1, mug, 0.9),
        mask(0, 2, book, 0.2),
        mask(1, 1, book, 0.2),
        mask(1, 2, mug, 0.9),
        mask(2, 1, mug, 0.8),
        mask(2, 2, spine, 0.3),
    ];
    // Numbers of key-point pairs, by (later mask, earlier mask).
    let pairs = Correspondences::from([((5, 2), 7)]);

    let mapped = paper(&masks, &pairs, &PaperConfig::default())?;
    for (mask, object) in masks.iter().zip(&mapped.object_of) {
        println!("photo {}, mask {}: object {object}", mask.view, mask.label);
    }
    assert_eq!(mapped.object_of, [1, 2, 2, 1, 1, 2]);

    // The object table, which answers queries: a code and all embeddings for each object.
    let grid = Grid::build(
        &masks,
        &mapped.object_of,
        codes::lattice(usize::from(mapped.count), 0),
    );
    for object in &grid.objects {
        println!(
            "object {}: code {:.2}, {} embeddings from {} photos",
            object.id,
            object.code,
            object.embeddings.len(),
            object.views
        );
    }
    Ok(())
}
