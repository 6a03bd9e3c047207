//! Lists the objects of a trained scene that are most similar to a given one, without a model.
//! A text query works in the same way, with the embedding of the text.
//!
//! `cargo run --release -p fastlgs-grid --example query -- SCENE OBJECT`

use fastlgs_core::SceneFolder;
use fastlgs_grid::Grid;
use fastlgs_grid::calibration::Calibration;
use fastlgs_grid::query::{QueryConfig, rank, select};
use fastlgs_grid::relevancy::TextQuery;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let (Some(scene), Some(object)) = (args.next(), args.next()) else {
        return Err("usage: query SCENE OBJECT".into());
    };
    let grid = Grid::load(&SceneFolder::open(Path::new(&scene))?)?;
    let object: usize = object.parse()?;
    let asked = grid
        .objects
        .get(object.wrapping_sub(1))
        .ok_or_else(|| format!("{scene} has objects 1 to {}", grid.objects.len()))?;
    let embedding = asked.embeddings.first().ok_or(
        "this object has no embedding, because its masks are too small; choose another one",
    )?;

    let query = TextQuery::new(vec![embedding.clone()], Calibration::OFFLINE);
    let ranked = rank(&grid, &query);
    for hit in ranked.iter().take(5) {
        println!("object {:4}  score {:.3}", hit.id, hit.score);
    }
    let answer: Vec<u16> = select(&grid, &ranked, &query, &QueryConfig::default())
        .iter()
        .map(|hit| hit.id)
        .collect();
    println!("targets: {answer:?}");
    Ok(())
}
