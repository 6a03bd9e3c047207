//! Runs the whole pipeline: makes a scene from photos with poses, and finds the pixels of an object
//! by a text.
//!
//! `cargo run --release -p fastlgs --example photos_to_answers -- PHOTOS SCENE TEXT`

use fastlgs::progress::{Message, Sink};
use fastlgs::{Run, Scene, preprocess, train};

/// Prints the name of each stage, and warnings.
struct Stages;

impl Sink for Stages {
    fn on_message(&self, message: Message<'_>) {
        match message {
            Message::Started { stage, total } => println!("{stage}: {total}"),
            Message::Warning(text) => println!("warning: {text}"),
            _ => {}
        }
    }
}

fn main() -> fastlgs::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [photos, scene, text] = arguments.as_slice() else {
        println!("usage: photos_to_answers PHOTOS SCENE TEXT");
        return Ok(());
    };
    let run = Run {
        progress: &Stages,
        ..Run::silent("auto", 0)
    };
    let preprocessed = fastlgs::preprocess(
        &preprocess::PreprocessConfig {
            photos: photos.into(),
            output: scene.into(),
            max_side: 320,
            ..Default::default()
        },
        &run,
    )?;
    println!(
        "{} photos, {} masks, {} points",
        preprocessed.photos, preprocessed.masks, preprocessed.points
    );
    let trained = fastlgs::train(
        &train::TrainConfig {
            scene: scene.into(),
            iterations: Some(600),
            ..Default::default()
        },
        &run,
    )?;
    println!(
        "{} Gaussians, {} objects, {:.1} dB on held-out views",
        trained.gaussians,
        trained.objects,
        trained.psnr_held_out.unwrap_or(f64::NAN)
    );

    let mut scene = Scene::open(scene.as_ref(), "auto")?;
    let answer = scene.query(text.as_str()).run()?;
    let report = &answer.report;
    println!(
        "{text}: {}, score {:.2}, {} pixels of {}",
        if report.found { "found" } else { "not found" },
        report.score,
        report.pixels,
        report.view
    );
    Ok(())
}
