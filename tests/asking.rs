//! Queries on a generated scene with exact masks: by text, picture, point and taught name, line by
//! line and in a terminal. Also tests the evaluation against labels.
//!
//! Needs the offline models ('fastlgs models install-offline') and a Vulkan device. Without them
//! the tests are skipped with a message, or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/run.rs"]
mod run;

use fastlgs_core::label_map::LabelMap;
use fastlgs_core::ply;
use run::{assert_fails, coffee_iou, fastlgs, fixture, json, text};
use serde_json::Value;
use std::path::Path;
use std::process::Command;

#[test]
fn exact_masks_give_exact_answers() {
    let Some(f) = fixture() else { return };
    let report = json(&[
        "eval",
        text(&f.scene),
        "--labels",
        text(&f.photos.join("labels")),
    ]);
    assert_eq!(report["views_scored"], 4);
    assert_eq!(report["labels_scored"], report["labels_total"]);
    println!("generated room at 320x240: {report}");
    assert!(
        report["oracle_miou"].as_f64().expect("a number") > 0.6,
        "{report}"
    );
    let answer = json(&[
        "query",
        text(&f.scene),
        "coffee",
        "--view",
        "008",
        "-o",
        text(&f.dir.path().join("out")),
        "--heatmap",
    ]);
    assert_eq!(answer["found"], true);
    let iou = coffee_iou(f, &answer);
    assert!(iou > 0.5, "the coffee's IoU is {iou}");
    assert!(Path::new(answer["heatmap"].as_str().expect("a path")).is_file());
    let ms = &answer["ms"];
    assert!(
        ["encode", "render", "restore", "total"]
            .iter()
            .all(|k| ms[k].as_f64().is_some_and(|v| v > 0.0)),
        "{ms}"
    );
}

#[test]
fn absent_objects_are_not_found() {
    let Some(f) = fixture() else { return };
    let output = fastlgs(&["query", text(&f.scene), "pizza", "--json", "-"]);
    assert_eq!(
        output.status.code(),
        Some(3),
        "{}",
        String::from_utf8_lossy(&output.stdout)
    );
    let answer: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(answer["found"], false);
    // The nearest objects are named, with the views that show them best.
    let nearest = answer["nearest"].as_array().expect("a list");
    assert_eq!(nearest.len(), 3, "{answer}");
    for (near, candidate) in nearest
        .iter()
        .zip(answer["candidates"].as_array().expect("a list"))
    {
        assert_eq!(
            (&near["id"], &near["score"]),
            (&candidate["id"], &candidate["score"])
        );
        let view = near["best_view"].as_str().expect("a view");
        assert!(f.photos.join("images").join(view).is_file(), "{view}");
    }
    // The message says how to accept one, and its advice works.
    let folder = f.dir.path().join("nearest");
    let output = fastlgs(&["query", text(&f.scene), "pizza", "-o", text(&folder)]);
    let message = String::from_utf8(output.stdout).expect("UTF-8");
    let id = nearest[0]["id"].to_string();
    let advice = format!("--object {id}");
    assert!(
        message.contains("nearest objects: #") && message.contains(&advice),
        "{message}"
    );
    let (_, rate) = message.split_once("--false-alarms ").expect("a rate");
    let rate = rate.split_whitespace().next().expect("a rate");
    let accepted = json(&["query", text(&f.scene), "pizza", "--false-alarms", rate]);
    assert_eq!(accepted["found"], true, "{accepted}");
    // The sheet has a tile for each: photo, render, objects, the answer, and three more.
    let (width, height) = image::image_dimensions(folder.join("sheet.png")).expect("a sheet");
    assert!(height > width / 2, "two rows: {width}x{height}");
}

#[test]
fn objects_are_listed_and_found_by_id() {
    let Some(f) = fixture() else { return };
    let folder = f.dir.path().join("listed");
    let listed = json(&["objects", text(&f.scene), "-o", text(&folder)]);
    let objects = listed["objects"].as_array().expect("a list");
    let share = |object: &Value| object["share"].as_f64().expect("a number");
    assert!(objects.is_sorted_by(|a, b| share(a) >= share(b)));
    for object in objects {
        assert!(object["names"].as_array().expect("names").len() <= 3);
        assert!(object["best_view"].is_string(), "{object}");
    }
    assert!(Path::new(listed["sheet"].as_str().expect("a path")).is_file());
    // The object that answers a text has a name like it.
    let coffee = json(&[
        "query",
        text(&f.scene),
        "coffee",
        "--view",
        "008",
        "-o",
        text(&folder),
    ]);
    let id = &coffee["objects"][0]["id"];
    let of_id = objects.iter().find(|object| object["id"] == *id);
    let names = of_id.expect("the object")["names"].to_string();
    assert!(
        ["coffee", "espresso", "cup", "mug"]
            .iter()
            .any(|word| names.contains(word)),
        "{names}"
    );
    // Its id gives the same mask.
    let by_id = json(&[
        "query",
        text(&f.scene),
        "--object",
        &id.to_string(),
        "--view",
        "008",
        "-o",
        text(&folder),
    ]);
    let mask =
        |answer: &Value| image::open(answer["mask"].as_str().expect("a path")).expect("a mask");
    assert_eq!(coffee["objects"].as_array().map(Vec::len), Some(1));
    assert_eq!(mask(&coffee), mask(&by_id));
    let count = objects.len();
    assert_fails(
        &[
            "query",
            text(&f.scene),
            "--object",
            &(count + 1).to_string(),
        ],
        &["object ids are 1 to"],
    );
}

#[test]
fn texts_pixels_and_pictures_find_the_same_object() {
    let Some(f) = fixture() else { return };
    let file = |name: &str| f.dir.path().join("asked").join(name);
    let run_query =
        |args: &[&str]| json(&[&["query", text(&f.scene)], args, &["--view", "008"]].concat());
    let cat = run_query(&[
        "cat",
        "--export",
        text(&file("cat.ply")),
        "--export-rest",
        text(&file("rest.ply")),
        "-o",
        text(&file("out")),
    ]);
    assert_eq!(cat["found"], true, "{cat}");
    let object = &cat["objects"][0];
    let [id, pixels] = ["id", "pixels"].map(|k| object[k].as_u64().expect("a number"));

    // The selection and the rest together are the scene.
    let [all, selected, rest] = [f.scene.join("scene.ply"), file("cat.ply"), file("rest.ply")]
        .map(|p| ply::read(&p).expect("a scene"));
    assert_eq!(
        selected.len() as u64,
        object["gaussians"].as_u64().expect("a number")
    );
    assert_eq!(selected.len() + rest.len(), all.len());
    let [low, high] = [0, 1].map(|k| object["bbox3d"][k][0].as_f64().expect("a number") as f32);
    let inside = selected
        .means
        .iter()
        .filter(|m| (low..=high).contains(&m.x))
        .count();
    assert!(
        inside * 10 > selected.len() * 9,
        "the box contains nearly all Gaussians of the object"
    );

    // Query by a pixel of the mask, by several pixels, and by a picture of the object.
    let mask = LabelMap::load(Path::new(cat["mask"].as_str().expect("a path"))).expect("the mask");
    let middle = mask.boxes()[255].expect("a box");
    let on_mask = (middle[0]..middle[2])
        .map(|x| (x, (middle[1] + middle[3]) / 2))
        .find(|(x, y)| mask.at(*x, *y) > 0)
        .expect("a pixel");
    let point = run_query(&["--point", &format!("{},{}", on_mask.0, on_mask.1)]);
    assert_eq!(point["objects"][0]["id"], id, "{point}");
    let pixels_of =
        (middle[1]..middle[3]).flat_map(|y| (middle[0]..middle[2]).map(move |x| (x, y)));
    let all: Vec<(u32, u32)> = pixels_of.filter(|(x, y)| mask.at(*x, *y) > 0).collect();
    let several: Vec<String> = (1..6)
        .map(|k| all[k * all.len() / 6])
        .map(|(x, y)| format!("{x},{y}"))
        .collect();
    let point = run_query(&["--point", &several.join("+")]);
    assert_eq!(point["objects"][0]["id"], id, "{point}");
    let wrong = fastlgs(&["query", text(&f.scene), "--point", "1,2+", "--view", "008"]);
    assert!(
        wrong.status.code() == Some(2)
            && String::from_utf8_lossy(&wrong.stderr).contains("120,45+160,70"),
        "{wrong:?}"
    );
    let photo =
        fastlgs_core::image_io::load_rgb(&f.photos.join("images/008.png")).expect("the photo");
    let crop = image::imageops::crop_imm(
        &photo,
        middle[0],
        middle[1],
        middle[2] - middle[0],
        middle[3] - middle[1],
    )
    .to_image();
    fastlgs_core::image_io::save_png(&file("crop.png"), crop).expect("a temporary file");
    let picture = run_query(&["--image", text(&file("crop.png")), "--false-alarms", "1"]);
    // A part of the object may match the picture better.
    let found = &picture["objects"][0];
    assert!(found["id"] == id || found["parent"] == id, "{picture}");

    // Dilated masks, and a text that its negatives exclude.
    let wide = run_query(&["cat", "--dilate", "3x3", "--dilate-times", "2"]);
    let grown = wide["pixels"].as_u64().expect("a number");
    assert!(grown > pixels && grown < 2 * pixels, "{grown} of {pixels}");
    let ruled_out = fastlgs(&[
        "query",
        text(&f.scene),
        "cat",
        "--negative",
        "cat",
        "--negative",
        "kitten",
    ]);
    assert_eq!(ruled_out.status.code(), Some(3));
    assert_fails(
        &["query", text(&f.scene), "--point", "4000,1"],
        &["4000,1", "outside"],
    );
    assert_fails(
        &["query", text(&f.scene), "--image", "nowhere.png"],
        &["nowhere.png"],
    );
    assert_fails(&["query", text(&f.scene), "-", "cat"], &["standard input"]);
    let together = json(&["query", text(&f.scene), "cat", "--point", "1,1"]);
    assert_eq!(together.as_array().map(Vec::len), Some(2));
    let printed = fastlgs(&["query", text(&f.scene), "cat", "--view", "008"]);
    let said = String::from_utf8_lossy(&printed.stdout).into_owned();
    assert!(
        said.starts_with("cat: found, confidence ") && said.contains(" pixels in 008.png"),
        "{said}"
    );
    assert_fails(
        &["export", text(&f.scene), text(&file("cat.xyz"))],
        &["cat.xyz", ".spz"],
    );
    assert!(!file("cat.xyz").exists());
    assert_fails(&["query", text(&f.scene), " "], &["text is empty"]);
}

#[test]
fn names_can_be_taught() {
    let Some(f) = fixture() else { return };
    let file = |name: &str| f.dir.path().join(name);
    let ask = |name: &str| json(&["query", text(&f.scene), name, "--view", "008"]);
    let cat = ask("cat");
    assert_eq!(
        (&cat["found"], &cat["taught"]),
        (&Value::Bool(true), &Value::Bool(false)),
        "{cat}"
    );
    let id = cat["objects"][0]["id"].to_string();
    let taught = json(&["teach", "Kocur  domowy", text(&f.scene), "--object", &id]);
    assert_eq!(
        (taught["name"].as_str(), taught["examples"].as_u64()),
        (Some("kocur domowy"), Some(1)),
        "{taught}"
    );
    let answer = ask("kocur Domowy");
    assert_eq!(
        (&answer["found"], &answer["taught"]),
        (&Value::Bool(true), &Value::Bool(true)),
        "{answer}"
    );
    assert_eq!(answer["objects"][0]["id"], cat["objects"][0]["id"]);
    // Names can also be taught by a pixel and by a picture.
    let bounds: Vec<u64> = cat["objects"][0]["bbox2d"]
        .as_array()
        .expect("a box")
        .iter()
        .map(|v| v.as_u64().expect("a number"))
        .collect();
    let middle = format!(
        "{},{}",
        (bounds[0] + bounds[2]) / 2,
        (bounds[1] + bounds[3]) / 2
    );
    let shown = json(&[
        "teach",
        "w srodku",
        text(&f.scene),
        "--view",
        "008",
        "--point",
        &middle,
    ]);
    assert_eq!(ask("w srodku")["objects"][0]["id"], shown["object"]);
    assert_eq!(
        json(&[
            "teach",
            "w srodku",
            text(&f.scene),
            "--image",
            text(&f.photos.join("images/008.png"))
        ])["examples"],
        2
    );

    // Names can be exported and imported. Names of another encoder fail at the query.
    let kept = file("names.json");
    json(&["names", "export", text(&kept)]);
    assert!(
        json(&["names", "list"])["names"]
            .as_array()
            .is_some_and(|n| n.len() >= 2)
    );
    json(&["names", "remove", "kocur domowy"]);
    assert_fails(&["names", "remove", "kocur domowy"], &["never taught"]);
    let foreign = std::fs::read_to_string(&kept)
        .expect("a file")
        .replace("\"offline ", "\"another ");
    std::fs::write(&kept, foreign).expect("a file");
    assert!(
        json(&["names", "import", text(&kept)])["came"]
            .as_u64()
            .is_some_and(|n| n >= 2)
    );
    assert_fails(
        &["query", text(&f.scene), "kocur domowy"],
        &["another encoder", "names remove"],
    );
    std::fs::write(&kept, "{}x").expect("a file");
    assert_fails(&["names", "import", text(&kept)], &["names.json"]);
    for (args, words) in [
        (
            &["teach", "  ", text(&f.scene), "--object", "1"][..],
            "name is empty",
        ),
        (
            &["teach", "x", text(&f.scene), "--object", "9999"],
            "none is 9999",
        ),
        (&["teach", "x", text(&f.scene)], "exactly one example"),
        (
            &[
                "teach",
                "x",
                text(&f.scene),
                "--view",
                "nowhere",
                "--point",
                "1,1",
            ],
            "nowhere",
        ),
    ] {
        assert_fails(args, &[words]);
    }
    json(&["names", "remove", "kocur domowy"]);
    json(&["names", "remove", "w srodku"]);
}

#[test]
fn a_terminal_gets_a_dialogue() {
    let Some(f) = fixture() else { return };
    let folder = f.dir.path().join("dialogue");
    let asked = format!(
        "{} query {} - --device cpu -o {}",
        env!("CARGO_BIN_EXE_fastlgs"),
        text(&f.scene),
        text(&folder)
    );
    // `script` runs the command in a terminal.
    let mut child = Command::new("script")
        .args(["-qec", &asked, "/dev/null"])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .expect("util-linux's script");
    let lines = b"save\nview 008\ncat\nview nowhere\nsubmarine\nsave\nquit\n";
    std::io::Write::write_all(&mut child.stdin.take().expect("piped"), lines).expect("a reader");
    let output = child.wait_with_output().expect("an end");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}");
    for words in [
        "nothing was asked yet",
        "008.png> ",
        "cat: found, confidence",
        "nowhere",
        "submarine: not found",
        "sheet.png",
    ] {
        assert!(said.contains(words), "the output lacks '{words}': {said}");
    }
    assert!(folder.join("sheet.png").is_file());
}

#[test]
fn texts_are_answered_line_by_line() {
    let Some(f) = fixture() else { return };
    let mut child = Command::new(env!("CARGO_BIN_EXE_fastlgs"))
        .args([
            "query",
            text(&f.scene),
            "-",
            "--view",
            "008",
            "--device",
            "cpu",
        ])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .expect("the binary starts");
    std::io::Write::write_all(
        &mut child.stdin.take().expect("piped"),
        b"cat\n\nsubmarine\nwhiskers of the cat\n",
    )
    .expect("a reader");
    let output = child.wait_with_output().expect("an end");
    assert!(output.status.success());
    let answers: Vec<Value> = String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|l| serde_json::from_str(l).expect("JSON"))
        .collect();
    let found: Vec<_> = answers
        .iter()
        .map(|a| (a["text"].as_str().expect("a text"), a["found"] == true))
        .collect();
    assert_eq!(
        found,
        [
            ("cat", true),
            ("submarine", false),
            ("whiskers of the cat", true)
        ]
    );
    assert!(
        answers[0]["ms"]["render"].as_f64() > Some(0.0) && answers[1]["ms"]["render"] == 0.0,
        "the view is rendered once"
    );
}

/// The same labels in three layouts give the same figures. Wrong labels are reported.
#[test]
fn labels_of_every_layout_agree() {
    let Some(f) = fixture() else { return };
    let at = |name: &str| f.dir.path().join("layouts").join(name);
    let names: Vec<String> = instance_names(&f.photos.join("instances.json"))
        .into_iter()
        .collect();
    let mut classes = String::new();
    for view in ["000", "008", "016", "024"] {
        let truth =
            LabelMap::load(&f.photos.join(format!("masks/{view}.png.png"))).expect("exact masks");
        for (k, name) in names
            .iter()
            .enumerate()
            .filter(|(k, _)| truth.labels.contains(&(*k as u16 + 1)))
        {
            let mask = truth.mask(k as u16 + 1);
            let picture = image::GrayImage::from_fn(320, 240, |x, y| {
                image::Luma([255 * u8::from(mask[(y * 320 + x) as usize])])
            });
            fastlgs_core::image_io::save_png(
                &at("3dovs/segmentations")
                    .join(view)
                    .join(format!("{name}.png")),
                picture.clone(),
            )
            .expect("a mask");
            if name == "cat" {
                fastlgs_core::image_io::save_png(&at("cat").join(format!("{view}.png")), picture)
                    .expect("a mask");
            }
        }
    }
    names.iter().for_each(|n| classes += &format!("{n}\n"));
    std::fs::write(at("3dovs/segmentations/classes.txt"), classes).expect("a list");
    let eval = |labels: &Path, more: &[&str]| {
        json(&[&["eval", text(&f.scene), "--labels", text(labels)], more].concat())
    };
    let (lerf, masks) = (eval(&f.photos.join("labels"), &[]), eval(&at("3dovs"), &[]));
    for figure in [
        "labels_scored",
        "miou",
        "oracle_miou",
        "macc",
        "apart",
        "boundary_iou",
    ] {
        let [a, b] = [&lerf, &masks].map(|report| report[figure].as_f64().expect("a number"));
        assert!(
            (a - b).abs() < 1e-9,
            "{figure}: {a} {b}; only the order of the sums differs"
        );
    }
    let cat = eval(&at("cat"), &[]);
    assert_eq!(
        cat["miou"], lerf["miou_by_label"]["cat"],
        "SPIn-NeRF's masks are named by their folder"
    );
    assert_eq!(
        eval(&at("cat"), &["--label-text", "a submarine"])["miou"],
        0.0
    );

    // Labels of views that were trained on, and of unknown views.
    let wrong = at("wrong");
    std::fs::create_dir_all(&wrong).expect("a folder");
    std::fs::copy(at("cat/008.png"), wrong.join("009.png")).expect("a mask");
    assert_fails(
        &["eval", text(&f.scene), "--labels", text(&wrong)],
        &["009.png", "trained on", "holdout_labels"],
    );
    std::fs::rename(wrong.join("009.png"), wrong.join("none.png")).expect("a mask");
    assert_fails(
        &["eval", text(&f.scene), "--labels", text(&wrong)],
        &["no view 'none'"],
    );

    // `--holdout-labels` holds out the labelled views.
    let scene = at("scene");
    let report = json(&[
        "preprocess",
        text(&f.photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--holdout-labels",
        text(&at("cat")),
        "--max-side",
        "96",
    ]);
    assert_eq!(
        (
            report["training_photos"].as_u64(),
            report["held_out"].as_u64()
        ),
        (Some(28), Some(4))
    );
    assert_fails(&["query", text(&scene), "cat"], &["never trained"]);
}

/// Returns the names of the instances of a generated scene.
fn instance_names(path: &Path) -> Vec<String> {
    let list: Value =
        serde_json::from_slice(&std::fs::read(path).expect("the instances")).expect("JSON");
    list.as_array()
        .expect("a list")
        .iter()
        .map(|i| i["name"].as_str().expect("a name").to_owned())
        .collect()
}
