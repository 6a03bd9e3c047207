//! Cuts a photo into regions and prints the word that fits each region best.
//!
//! Needs the models of `fastlgs models install-offline`.
//!
//! `cargo run --release -p fastlgs-vision --example name_photo -- photo.jpg cat coffee bicycle`

use fastlgs_core::{Level, image_io};
use fastlgs_vision::{Conse, Encoder, OfflineSegmenter, OfflineText, Segmenter, TextEncoder};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let Some((photo, words)) = args.split_first().filter(|(_, words)| !words.is_empty()) else {
        return Err("usage: name_photo photo.jpg WORD...".into());
    };
    let pixels = image_io::resize(&image_io::load_rgb(Path::new(photo))?, 480, 360);
    let texts: Vec<&str> = words.iter().map(String::as_str).collect();
    let texts = OfflineText::load()?.embed(&texts)?;

    let masks = OfflineSegmenter::load()?
        .segment(photo, &pixels)?
        .painted(Level::Whole);
    let embeddings = Conse::load()?.embed_masks(photo, &pixels, &masks)?;
    for (label, (embedding, area)) in embeddings
        .iter()
        .zip(masks.areas().into_iter().skip(1))
        .enumerate()
    {
        let cosine = |text: &Vec<f32>| text.iter().zip(embedding).map(|(a, b)| a * b).sum::<f32>();
        let best = texts
            .iter()
            .map(cosine)
            .enumerate()
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .expect("there are words");
        println!(
            "region {:3}, {area:6} pixels: {} ({:.2})",
            label + 1,
            words[best.0],
            best.1
        );
    }
    Ok(())
}
