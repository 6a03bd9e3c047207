//! Tools around a scene: libraries, exchange with other programs, scripts, manual pages.
//!
//! Needs the offline models and a Vulkan device. Without them the tests are skipped with a message,
//! or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/run.rs"]
mod run;

use fastlgs_core::gaussians::sigmoid;
use fastlgs_core::{Camera, Gaussians, camera_path, ply, sog, spz};
use run::{assert_fails, copy_folder, fastlgs, json, text};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// Two trained scenes below `scenes`, with their photos.
struct Library {
    dir: tempfile::TempDir,
    photos: PathBuf,
    scenes: PathBuf,
}

/// Returns two generated and trained scenes. `None` without models or device.
fn library() -> Option<&'static Library> {
    static LIBRARY: OnceLock<Option<Library>> = OnceLock::new();
    let make = || {
        if !run::requirements_met() {
            return None;
        }
        let dir = tempfile::tempdir().expect("a temporary folder");
        let (photos, scenes) = (dir.path().join("photos"), dir.path().join("scenes"));
        for kind in ["room", "table"] {
            let (photos, scene) = (photos.join(kind), scenes.join(kind));
            json(&[
                "synth",
                kind,
                "-o",
                text(&photos),
                "--views",
                "20",
                "--size",
                "200x150",
            ]);
            json(&[
                "preprocess",
                text(&photos),
                "-o",
                text(&scene),
                "--segmenter",
                "import",
                "--device",
                "cpu",
            ]);
            json(&[
                "train",
                text(&scene),
                "--iterations",
                "500",
                "--budget",
                "8000",
                "--device",
                "cpu",
            ]);
        }
        Some(Library {
            dir,
            photos,
            scenes,
        })
    };
    LIBRARY.get_or_init(make).as_ref()
}

#[test]
fn one_command_makes_a_scene_and_keeps_it_until_the_photos_change() {
    let Some(l) = library() else { return };
    let (photos, scene) = (
        l.dir.path().join("made photos"),
        l.dir.path().join("made scene"),
    );
    json(&[
        "synth",
        "table",
        "-o",
        text(&photos),
        "--views",
        "8",
        "--size",
        "96x72",
    ]);
    let args = [
        "make",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--device",
        "cpu",
    ];
    let made = json(&args);
    assert_eq!(
        (
            made["state"].as_str(),
            made["photos"][0].as_u64(),
            made["photos"][1].as_u64()
        ),
        (Some("made"), Some(7), Some(1)),
        "{made}"
    );
    let stamp = || {
        std::fs::metadata(scene.join("scene.ply"))
            .expect("a scene")
            .modified()
            .expect("a time")
    };
    let before = stamp();
    let printed = String::from_utf8(fastlgs(&args).stdout).expect("words");
    assert!(
        printed.contains("is up to date") && printed.contains("fastlgs serve '"),
        "{printed}"
    );
    assert_eq!(before, stamp());
    // Replaces the first photo by another one.
    std::fs::copy(photos.join("images/001.png"), photos.join("images/000.png")).expect("a photo");
    assert_eq!(json(&args)["state"], "made");
    assert_fails(
        &["make", text(&photos.join("none")), "-o", text(&scene)],
        &["none", "cannot be opened"],
    );
}

#[test]
fn a_library_query_lists_the_scenes_with_the_object() {
    let Some(l) = library() else { return };
    let scenes = l.dir.path().join("library");
    copy_folder(&l.scenes, &scenes);
    let library = text(&scenes);
    let found = json(&["query", "--library", library, "cat"]);
    assert_eq!(
        (
            found["found"].as_bool(),
            found["scenes"][0]["scene"].as_str()
        ),
        (Some(true), Some("room")),
        "{found}"
    );
    assert_eq!(found["searched"]["scenes"], 2);
    // The scene itself gives the same score to that object.
    let own = json(&[
        "query",
        text(&scenes.join("room")),
        "cat",
        "--device",
        "cpu",
    ]);
    let same = own["candidates"]
        .as_array()
        .expect("hits")
        .iter()
        .find(|c| c["id"] == found["scenes"][0]["object"])
        .expect("the object");
    assert!(
        (same["score"].as_f64().expect("a score")
            - found["scenes"][0]["score"].as_f64().expect("a score"))
        .abs()
            < 0.01,
        "{own} {found}"
    );

    // The same holds for a part of an object.
    let part = json(&["query", "--library", library, "nose of the cat"]);
    let own = json(&[
        "query",
        text(&scenes.join("room")),
        "nose of the cat",
        "--device",
        "cpu",
    ]);
    let row = part["scenes"]
        .as_array()
        .expect("rows")
        .iter()
        .find(|row| row["scene"] == "room")
        .expect("the room");
    let score = |answer: &Value| answer["score"].as_f64().expect("a score");
    assert!(
        (score(&own) - score(row)).abs() < 0.01 && row["found"] == own["found"],
        "{own} {part}"
    );

    let absent = fastlgs(&[
        "query",
        "--library",
        library,
        "aircraft carrier",
        "--json",
        "-",
    ]);
    assert_eq!(
        absent.status.code(),
        Some(3),
        "{}",
        String::from_utf8_lossy(&absent.stdout)
    );

    // A new scene is found. A damaged scene folder is reported.
    copy_folder(&scenes.join("room"), &scenes.join("more/room again"));
    std::fs::create_dir(scenes.join("broken")).expect("a folder");
    std::fs::write(scenes.join("broken/scene.json"), "{").expect("a file");
    let mut lines = Command::new(env!("CARGO_BIN_EXE_fastlgs"))
        .args(["query", "--library", library, "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("the binary starts");
    std::io::Write::write_all(&mut lines.stdin.take().expect("piped"), b"cat\n\ncoffee\n")
        .expect("written");
    let output = lines.wait_with_output().expect("it ends");
    let answers: Vec<Value> = String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|l| serde_json::from_str(l).expect("JSON"))
        .collect();
    assert_eq!(answers.len(), 2);
    let names: Vec<&str> = answers[0]["scenes"]
        .as_array()
        .expect("rows")
        .iter()
        .filter_map(|r| r["scene"].as_str())
        .collect();
    assert!(
        names.contains(&"room") && names.contains(&"more/room again"),
        "{names:?}"
    );
    assert_eq!(answers[0]["skipped"][0]["scene"], "broken");

    assert_fails(
        &["query", "--library", text(&l.photos), "cat"],
        &["no trained scenes"],
    );
    assert_fails(&["query", "--library", library], &["give a text to find"]);
    assert_fails(
        &["query", "--library", library, "cat", "--point", "1,1"],
        &["--library"],
    );
}

#[test]
fn scenes_of_other_programs_get_objects() {
    let Some(l) = library() else { return };
    let scene = l.dir.path().join("foreign");
    copy_folder(&l.scenes.join("room"), &scene);
    let gaussians = ply::read(&scene.join("scene.ply")).expect("a scene");
    let own = json(&["info", text(&scene)])["objects"]
        .as_u64()
        .expect("objects");

    // A PLY file as Brush and gsplat write it: other column order, no normals, no features,
    // quaternions that are not normalised.
    let (dc, rest) = (
        ["f_dc_0", "f_dc_1", "f_dc_2"],
        gaussians.sh_rest.len() / gaussians.len() * 3,
    );
    let mut names: Vec<String> = [
        "rot_0", "rot_1", "rot_2", "rot_3", "x", "y", "z", "opacity", "scale_0", "scale_1",
        "scale_2",
    ]
    .map(str::to_owned)
    .to_vec();
    names.extend(dc.map(str::to_owned));
    names.extend((0..rest).map(|k| format!("f_rest_{k}")));
    let header: String = names
        .iter()
        .map(|n| format!("property float {n}\n"))
        .collect();
    let mut data = format!(
        "ply\nformat binary_little_endian 1.0\ncomment Exported from elsewhere\nelement vertex {}\n{header}end_header\n",
        gaussians.len()
    )
    .into_bytes();
    for i in 0..gaussians.len() {
        let (q, m, s, c) = (
            gaussians.rotations[i],
            gaussians.means[i],
            gaussians.log_scales[i],
            gaussians.sh_dc[i],
        );
        let mut row = vec![
            2.0 * q[0],
            2.0 * q[1],
            2.0 * q[2],
            2.0 * q[3],
            m.x,
            m.y,
            m.z,
            gaussians.opacity_logits[i],
            s.x,
            s.y,
            s.z,
            c.x,
            c.y,
            c.z,
        ];
        row.extend((0..3).flat_map(|color| gaussians.rest(i).iter().map(move |v| v[color])));
        data.extend(row.iter().flat_map(|v| v.to_le_bytes()));
    }
    let path = l.dir.path().join("other.ply");
    std::fs::write(&path, data).expect("a file");
    let report = json(&[
        "train",
        text(&scene),
        "--init",
        text(&path),
        "--iterations",
        "0",
        "--device",
        "cpu",
    ]);
    let lifted = report["objects"].as_u64().expect("objects");
    assert!(
        lifted.abs_diff(own) <= own / 5 + 1,
        "{lifted} objects, {own} before"
    );
    assert_eq!(
        json(&["query", text(&scene), "cat", "--device", "cpu"])["found"],
        true
    );
}

#[test]
fn selections_and_camera_paths_are_exported_and_read() {
    let Some(l) = library() else { return };
    let room = l.scenes.join("room");
    let out = l.dir.path().join("exchange");
    for ending in fastlgs::query::selection::EXTENSIONS {
        let file = out.join(format!("cat.{ending}"));
        let answer = json(&[
            "query",
            text(&room),
            "cat",
            "--export",
            text(&file),
            "--device",
            "cpu",
        ]);
        assert_eq!(answer["found"], true);
        let magic: &[u8] = match ending {
            "ply" => b"ply\n",
            "spz" => &[0x1f, 0x8b],
            "sog" => b"PK",
            _ => b"glTF",
        };
        assert!(
            std::fs::read(&file)
                .expect("the selection")
                .starts_with(magic),
            "{ending}"
        );
    }
    let selected = ply::read(&out.join("cat.ply")).expect("a scene").len();
    json(&[
        "query",
        text(&room),
        "cat",
        "--export-rest",
        text(&out.join("rest.ply")),
        "--device",
        "cpu",
    ]);
    let rest = ply::read(&out.join("rest.ply")).expect("a scene").len();
    assert_eq!(
        selected + rest,
        ply::read(&room.join("scene.ply")).expect("a scene").len()
    );
    assert_fails(
        &[
            "query",
            text(&room),
            "cat",
            "--export",
            text(&out.join("cat.obj")),
            "--device",
            "cpu",
        ],
        &["cat.obj", ".glb"],
    );
    let whole = out.join("room.glb");
    assert!(
        json(&["export", text(&room), text(&whole), "--device", "cpu"])["bytes"].as_u64()
            > Some(100_000)
    );

    let path = out.join("cameras.json");
    let report = json(&["export", text(&room), text(&path)]);
    let cameras: Vec<Camera> =
        camera_path::read(&path, &fastlgs_core::WorldFrame::default()).expect("a path");
    assert_eq!(report["frames"].as_u64(), Some(cameras.len() as u64));
    // Two frames without names, as nerfstudio writes them.
    let mut file: Value =
        serde_json::from_slice(&std::fs::read(&path).expect("the path")).expect("JSON");
    let frames = file["camera_path"].as_array_mut().expect("frames");
    frames.truncate(2);
    frames
        .iter_mut()
        .for_each(|f| drop(f.as_object_mut().expect("a frame").remove("name")));
    std::fs::write(&path, file.to_string()).expect("a file");
    let pictures = out.join("pictures");
    json(&[
        "render",
        text(&room),
        "--path",
        text(&path),
        "-o",
        text(&pictures),
        "--device",
        "cpu",
    ]);
    json(&[
        "render",
        text(&room),
        "--view",
        "001",
        "-o",
        text(&pictures),
        "--device",
        "cpu",
    ]);
    let own =
        fastlgs_core::image_io::load_rgb(&pictures.join("001.png.color.png")).expect("a picture");
    let by_path = fastlgs_core::image_io::load_rgb(&pictures.join("frame_00001.color.png"))
        .expect("a picture");
    let differing = own
        .as_raw()
        .iter()
        .zip(by_path.as_raw())
        .filter(|(a, b)| a.abs_diff(**b) > 2)
        .count();
    assert!(
        differing * 1000 < own.as_raw().len(),
        "{differing} values differ"
    );
}

/// Installs programs of others by npm once, and returns their folder. `None` without npm.
fn other_programs() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("npm");
    let npm = |args: &[&str]| Command::new("npm").args(args).current_dir(&root).output();
    std::fs::create_dir_all(&root).expect("a folder");
    if npm(&["--version"]).is_err() {
        assert!(
            std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(),
            "npm is missing; run ./setup.sh --tests to install it"
        );
        run::skip("npm is not installed; it installs the programs that read our exports");
        return None;
    }
    let bin = root.join("node_modules");
    if !bin.join("gltf-validator").is_dir() {
        std::fs::write(root.join("package.json"), "{}").expect("a file");
        let packages = [
            "install",
            "--silent",
            "@playcanvas/splat-transform@2.7.1",
            "gltf-validator@2.0.0-dev.3.10",
        ];
        let done = npm(&packages).expect("npm starts");
        assert!(
            done.status.success(),
            "npm: {}",
            String::from_utf8_lossy(&done.stderr)
        );
    }
    Some(bin)
}

#[test]
fn other_programs_read_exported_files() {
    let (Some(l), Some(others)) = (library(), other_programs()) else {
        return;
    };
    let room = l.scenes.join("room");
    let out = l.dir.path().join("others");
    let node = |args: &[&str]| {
        let done = Command::new("node")
            .args(args)
            .output()
            .expect("node starts");
        assert!(
            done.status.success(),
            "{args:?}: {}",
            String::from_utf8_lossy(&done.stderr)
        );
        done.stdout
    };
    let transform = others.join("@playcanvas/splat-transform/bin/cli.mjs");
    let convert = |from: &Path, to: &Path| {
        drop(node(&[
            text(&transform),
            "-q",
            "-w",
            "-g",
            "cpu",
            text(from),
            text(to),
        ]))
    };
    let own = |path: &Path| match path.extension().and_then(|e| e.to_str()) {
        Some("spz") => spz::read(path).expect("an SPZ file"),
        Some("sog") => sog::read(path).expect("a SOG file"),
        _ => ply::read(path).expect("a PLY file"),
    };
    // Other programs must read our files, and we theirs, as the same Gaussians. The order may
    // differ.
    let same = |ours: Gaussians, theirs: Gaussians, close: f32| {
        assert_eq!(
            (ours.len(), ours.sh_degree),
            (theirs.len(), theirs.sh_degree)
        );
        let sorted = |g: Gaussians| {
            let mut places: Vec<usize> = (0..g.len()).collect();
            let key = |i: &usize| g.means[*i].to_array().map(|v| (v * 1e4).round() as i64);
            places.sort_by_key(key);
            g.select(&places)
        };
        let (ours, theirs) = (sorted(ours), sorted(theirs));
        let mismatches = (0..ours.len()).filter(|&i| {
            let apart = |a: [f32; 3], b: [f32; 3]| {
                a.iter()
                    .zip(b)
                    .map(|(a, b)| (a - b).abs())
                    .fold(0.0, f32::max)
            };
            let opacity = sigmoid(ours.opacity_logits[i]) - sigmoid(theirs.opacity_logits[i]);
            let rest = ours
                .rest(i)
                .iter()
                .zip(theirs.rest(i))
                .map(|(a, b)| apart(a.to_array(), b.to_array()))
                .fold(0.0, f32::max);
            apart(ours.means[i].to_array(), theirs.means[i].to_array()) > close
                || apart(
                    ours.log_scales[i].to_array(),
                    theirs.log_scales[i].to_array(),
                ) > close
                || apart(ours.sh_dc[i].to_array(), theirs.sh_dc[i].to_array()) > close
                || rest > close
                || opacity.abs() > close.max(2e-3)
                || ours.rotation(i).dot(theirs.rotation(i)).abs() < 1.0 - close
        });
        // Gaussians with the same position may be sorted in any order.
        let off = mismatches.count();
        assert!(
            off * 100 <= ours.len(),
            "{off} of {} Gaussians differ",
            ours.len()
        );
    };
    for ending in ["ply", "spz", "sog"] {
        let (file, back) = (
            out.join(format!("room.{ending}")),
            out.join(format!("{ending}.ply")),
        );
        json(&["export", text(&room), text(&file), "--device", "cpu"]);
        convert(&file, &back);
        same(own(&file), own(&back), 1e-3);
    }
    let theirs = out.join("theirs.sog");
    convert(&out.join("room.ply"), &theirs);
    let back = out.join("theirs.ply");
    convert(&theirs, &back);
    same(own(&theirs), own(&back), 1e-3);
    println!(
        "SOG: {} bytes by fastlgs, {} bytes by splat-transform",
        bytes(&out.join("room.sog")),
        bytes(&theirs)
    );

    let glb = out.join("room.glb");
    json(&["export", text(&room), text(&glb), "--device", "cpu"]);
    let validate =
        "const v = require(process.argv[1]); const f = require('fs').readFileSync(process.argv[2]);
        v.validateBytes(new Uint8Array(f)).then((r) => console.log(JSON.stringify(r)));";
    let report = node(&[
        "-e",
        validate,
        text(&others.join("gltf-validator")),
        text(&glb),
    ]);
    let report: Value = serde_json::from_slice(&report).expect("JSON");
    // The validator knows neither the extension nor attribute names with a colon.
    let known = |m: &&Value| {
        let own = m["pointer"].as_str().is_some_and(|p| {
            p.contains("/attributes/KHR_gaussian_splatting:") || p == "/extensionsUsed/0"
        });
        !(own
            && ["MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"]
                .iter()
                .any(|code| m["code"] == *code))
    };
    let messages: Vec<&Value> = report["issues"]["messages"]
        .as_array()
        .expect("messages")
        .iter()
        .filter(known)
        .collect();
    assert!(messages.is_empty(), "{messages:?}");
    assert_eq!(
        report["info"]["extensionsUsed"],
        serde_json::json!(["KHR_gaussian_splatting"])
    );
}

fn bytes(path: &Path) -> u64 {
    std::fs::metadata(path).expect("a file").len()
}

#[test]
fn completions_and_manual_pages_are_complete() {
    for (shell, word) in [
        ("bash", "complete"),
        ("zsh", "#compdef"),
        ("fish", "complete -c fastlgs"),
    ] {
        let output = fastlgs(&["completions", shell]);
        let script = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(
            output.status.success() && script.contains(word) && script.contains("preprocess"),
            "{shell}"
        );
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    assert!(fastlgs(&["man", "-o", text(dir.path())]).status.success());
    let page = std::fs::read_to_string(dir.path().join("fastlgs-query.1")).expect("a page");
    assert!(page.contains("tau\\-ac") && dir.path().join("fastlgs.1").is_file());
}

/// Runs the examples that `cargo test` has built, and the Python example, on a trained scene.
#[test]
fn examples_run() {
    let Some(l) = library() else { return };
    let (room, out) = (l.scenes.join("room"), l.dir.path().join("examples"));
    std::fs::create_dir(&out).expect("a folder");
    let built = Path::new(env!("CARGO_BIN_EXE_fastlgs")).with_file_name("examples");
    let run = |name: &str, args: &[&str]| -> String {
        let program = built.join(name);
        if !program.is_file() {
            assert!(
                std::env::var_os("FASTLGS_REQUIRE_GPU").is_none(),
                "{} is missing; run 'cargo build --release --examples'",
                program.display()
            );
            run::skip(format_args!("{} is not built", program.display()));
            return String::new();
        }
        let output = Command::new(program)
            .args(args)
            .output()
            .expect("it starts");
        assert!(
            output.status.success(),
            "{name}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let picture = l.photos.join("room/images/000.png");
    let (scene, rendered, labelled) =
        (room.join("scene.ply"), out.join("p.png"), out.join("l.ply"));
    for (name, args, word) in [
        (
            "read_dataset",
            vec![text(&l.photos.join("room")).to_owned()],
            "20 photos",
        ),
        (
            "render_ply",
            vec![
                text(&scene).to_owned(),
                text(&rendered).to_owned(),
                "cpu".to_owned(),
            ],
            "Gaussians",
        ),
        (
            "lift_labels",
            vec![text(&room).to_owned(), text(&labelled).to_owned()],
            "have a label",
        ),
        ("map_masks", vec![], "object 2"),
        (
            "query",
            vec![text(&room).to_owned(), "1".to_owned()],
            "targets: [",
        ),
        (
            "name_photo",
            vec![
                text(&picture).to_owned(),
                "cat".to_owned(),
                "coffee".to_owned(),
            ],
            "region",
        ),
    ] {
        let said = run(name, &args.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(said.is_empty() || said.contains(word), "{name}: {said}");
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/find.py");
    let python = Command::new("python3")
        .arg(script)
        .args([text(&room), "cat", "pizza"])
        .env("FASTLGS", env!("CARGO_BIN_EXE_fastlgs"))
        .output();
    let python = python.expect("python3");
    let said = String::from_utf8_lossy(&python.stdout).into_owned();
    assert!(
        python.status.success(),
        "{}",
        String::from_utf8_lossy(&python.stderr)
    );
    assert!(
        said.contains("cat: object") && said.contains("pizza: not found"),
        "{said}"
    );
}

/// Runs the workflow on two scenes. FASTLGS_SNAKEMAKE names the program.
#[test]
fn snakemake_runs_the_workflow_on_two_scenes() {
    let Some(snakemake) = std::env::var_os("FASTLGS_SNAKEMAKE") else {
        run::skip("FASTLGS_SNAKEMAKE is not set to the path of snakemake");
        return;
    };
    if !run::requirements_met() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    for kind in ["room", "table"] {
        json(&[
            "synth",
            kind,
            "-o",
            text(&dir.path().join("photos").join(kind)),
            "--views",
            "16",
            "--size",
            "160x120",
        ]);
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../workflows/Snakefile");
    let snake = |more: &[&str]| {
        let output = Command::new(&snakemake)
            .current_dir(dir.path())
            .args(["-s", text(&file), "--cores", "2", "--quiet", "all"])
            .args(more)
            .args([
                "--config",
                &format!("fastlgs={}", env!("CARGO_BIN_EXE_fastlgs")),
                "device=cpu",
            ])
            .args([
                "preprocess=--segmenter import",
                "train=--iterations 300 --budget 6000",
            ])
            .output()
            .expect("snakemake starts");
        assert!(
            output.status.success(),
            "{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    };
    snake(&[]);
    let reports = dir.path().join("scenes/reports");
    let report = |name: &str| -> Value {
        serde_json::from_slice(&std::fs::read(reports.join(name)).expect("a report")).expect("JSON")
    };
    assert!(report("room.train.json")["objects"].as_u64() > Some(0));
    assert!(report("table.eval.json").is_object());
    assert_eq!(report("library.json")["searched"]["scenes"], 2);
    // A second run has nothing to do.
    let stamp = std::fs::metadata(reports.join("room.train.json"))
        .expect("a report")
        .modified()
        .expect("a time");
    snake(&[]);
    assert_eq!(
        stamp,
        std::fs::metadata(reports.join("room.train.json"))
            .expect("a report")
            .modified()
            .expect("a time")
    );
}
