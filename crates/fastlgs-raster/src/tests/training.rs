//! Tests of whole trainings: resumed runs, budgets, free space, and learned exposure and
//! background.

use super::{camera, cloud, gpu, target};
use crate::{
    Budget, CpuEngine, Engine, FreeSpace, Gpu, GpuEngine, Target, Trainer, TrainerConfig,
    TrainerReport,
};
use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::Vec3;

fn views(count: usize) -> Vec<Target> {
    let around = |k: usize| {
        let angle = k as f32 * 0.3;
        Camera::look_at(
            &format!("v{k}"),
            4.0 * Vec3::new(angle.sin(), 0.1, -angle.cos()),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.9,
        )
    };
    (0..count)
        .map(|k| Target {
            camera: around(k),
            image: target(64, 48),
            gain: [1.0; 3],
        })
        .collect()
}

fn trainer(engine: Box<dyn Engine>, config: TrainerConfig) -> Trainer {
    Trainer::new(engine, &cloud(200, 8, 0, false), views(24), config).unwrap()
}

fn run(config: TrainerConfig) -> (Trainer, TrainerReport) {
    let mut trainer = trainer(Box::new(CpuEngine::new()), config);
    let report = trainer.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
    (trainer, report)
}

#[test]
fn resumes_to_the_same_bytes() {
    let Some(_) = gpu() else { return };
    let dir = tempfile::tempdir().unwrap();
    let config = TrainerConfig {
        iterations: 600,
        budget: Budget::Auto(400),
        sh_degree: 1,
        exposure: true,
        learn_background: true,
        ..TrainerConfig::default()
    };
    let start = || {
        trainer(
            Box::new(GpuEngine::new(Gpu::open("auto").unwrap())),
            config.clone(),
        )
    };
    let bytes = |trainer: &Trainer, name: &str| {
        let path = dir.path().join(name);
        fastlgs_core::ply::write(&path, &trainer.gaussians().unwrap()).unwrap();
        std::fs::read(path).unwrap()
    };
    let checkpoint = dir.path().join("train");
    let mut whole = start();
    whole
        .run(Some(&checkpoint), |_, _| Ok::<_, crate::Error>(()))
        .unwrap();
    let mut again = start();
    again.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
    assert_eq!(
        bytes(&whole, "a.ply"),
        bytes(&again, "b.ply"),
        "twice in a row"
    );
    let mut resumed = start();
    assert!(
        resumed.resume(&checkpoint).unwrap(),
        "a checkpoint was left at step 500"
    );
    let report = resumed.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
    assert_eq!(report.steps_here, 100);
    assert_eq!(bytes(&whole, "a.ply"), bytes(&resumed, "c.ply"), "resumed");
    assert_eq!(whole.exposures(), resumed.exposures());
    let fewer = Trainer::new(
        Box::new(CpuEngine::new()),
        &cloud(200, 8, 0, false),
        views(23),
        config.clone(),
    )
    .unwrap();
    let message = { fewer }.resume(&checkpoint).unwrap_err().to_string();
    assert!(message.contains("other photos"), "{message}");
    let other = TrainerConfig {
        lambda: 0.3,
        ..config
    };
    let message = trainer(Box::new(CpuEngine::new()), other)
        .resume(&checkpoint)
        .unwrap_err()
        .to_string();
    assert!(message.contains("other options"), "{message}");
}

#[test]
fn coupling_starts_at_its_step_and_continues_in_a_resumed_run() {
    let dir = tempfile::tempdir().unwrap();
    let checkpoint = dir.path().join("train");
    let config = TrainerConfig {
        iterations: 600,
        budget: Budget::Auto(400),
        feature_weight: 0.5,
        ..TrainerConfig::default()
    };
    let start = || trainer(Box::new(CpuEngine::new()), config.clone());
    let set_codes = |trainer: &mut Trainer| trainer.set_codes(|_| Ok(target(64, 48).feature));
    let mut errors = Vec::new();
    let mut whole = start();
    let shaped = whole.run(Some(&checkpoint), |progress, trainer| {
        if progress.iteration == 100 {
            trainer.couple(|_, scene, cameras| {
                assert_eq!(cameras.len(), 24);
                scene.features.fill(Vec3::splat(0.5));
                Ok::<_, crate::Error>(())
            })?;
            set_codes(trainer);
        }
        errors.push(progress.losses.feature_l1);
        Ok::<_, crate::Error>(())
    });
    shaped.unwrap();
    let after = |steps: usize| errors[steps / 20 - 1];
    assert!(
        after(100) == 0.0 && after(120) > 0.0,
        "from step 100 on: {errors:?}"
    );
    assert!(after(600) < 0.9 * after(120), "{errors:?}");
    let mut resumed = start();
    assert!(!resumed.is_coupled() && resumed.resume(&checkpoint).unwrap() && resumed.is_coupled());
    set_codes(&mut resumed);
    resumed.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
    assert!(whole.gaussians().unwrap() == resumed.gaussians().unwrap());
    let (by_color, _) = run(config.clone());
    assert!(
        whole.gaussians().unwrap().means != by_color.gaussians().unwrap().means,
        "masks change geometry"
    );
    let refused = start().couple(|_, _, _| Err(crate::Error::Invalid("no objects".to_owned())));
    assert!(refused.is_err());
}

#[test]
fn density_control_removes_gaussians_in_free_space() {
    let config = TrainerConfig {
        iterations: 100,
        refine_until: 0.8,
        budget: Budget::Fixed(400),
        ..TrainerConfig::default()
    };
    let cameras: Vec<Camera> = views(24).into_iter().map(|view| view.camera).collect();
    // A wall behind the cloud, observed by three cameras.
    let steps = || (-20..=20).map(|k| 0.1 * k as f32);
    let wall = steps().flat_map(|x| steps().map(move |y| Vec3::new(x, y, 3.0)));
    let wall: Vec<SfmPoint> = wall
        .map(|position| SfmPoint {
            position,
            color: [0; 3],
            seen_by: vec![0, 1, 2],
        })
        .collect();
    let free = FreeSpace::of(&cameras, &[], &wall);
    let in_free_space = |keep_free: bool| {
        let mut trainer = trainer(Box::new(CpuEngine::new()), config.clone());
        if keep_free {
            trainer.set_free_space(free.clone());
        }
        trainer.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
        trainer
            .gaussians()
            .unwrap()
            .means
            .iter()
            .filter(|mean| free.contains(**mean))
            .count()
    };
    let [unrestricted, kept_free] = [false, true].map(in_free_space);
    assert!(
        unrestricted > 20 && 10 * kept_free < unrestricted,
        "{unrestricted} Gaussians in free space without the rule, {kept_free} with it"
    );
}

#[test]
fn density_control_keeps_the_budget() {
    let (_, report) = run(TrainerConfig {
        iterations: 800,
        budget: Budget::Fixed(300),
        ..TrainerConfig::default()
    });
    assert!(
        report.gaussians <= 300 && report.gaussians > 200,
        "{}",
        report.gaussians
    );
    assert!(report.removals.is_empty());
}

#[test]
fn an_automatic_budget_removes_unimportant_gaussians() {
    let (_, report) = run(TrainerConfig {
        iterations: 800,
        budget: Budget::Auto(1000),
        ..TrainerConfig::default()
    });
    assert_eq!(report.removals.len(), 2);
    assert!(report.removals.iter().all(|r| r.after <= r.before));
    assert_eq!(report.gaussians, report.removals[1].after);
}

#[test]
fn exposure_and_background_are_learned() {
    // Photos of constant grey. No Gaussian is visible, so that only background and exposure can fit
    // them.
    let mut targets = views(2);
    let gray = |v: u8| vec![crate::pack([v; 3], true); 64 * 48];
    (targets[0].image.color, targets[1].image.color) = (gray(100), gray(110));
    let mut scene = cloud(1, 1, 0, false);
    scene.means[0] = Vec3::new(0.0, 500.0, 0.0);
    let config = TrainerConfig {
        iterations: 600,
        exposure: true,
        learn_background: true,
        background: [0.5; 3],
        ..TrainerConfig::default()
    };
    let config = TrainerConfig {
        refine_until: 0.0,
        ..config
    };
    let mut trainer = Trainer::new(Box::new(CpuEngine::new()), &scene, targets, config).unwrap();
    let report = trainer.run(None, |_, _| Ok::<_, crate::Error>(())).unwrap();
    let seen = |k: usize| {
        trainer.exposures()[k].gain[0] * report.background[0] + trainer.exposures()[k].offset[0]
    };
    assert!(
        (seen(0) - 100.0 / 255.0).abs() < 0.01 && (seen(1) - 110.0 / 255.0).abs() < 0.01,
        "{} {}",
        seen(0),
        seen(1)
    );
}

#[test]
fn training_without_views_is_an_error() {
    let engine = Box::new(CpuEngine::new());
    let message = Trainer::new(
        engine,
        &cloud(5, 1, 0, false),
        Vec::new(),
        TrainerConfig::default(),
    )
    .err()
    .unwrap()
    .to_string();
    assert!(message.contains("no training views"), "{message}");
    assert!(camera(4, 4).check().is_ok());
}
