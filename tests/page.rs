//! The viewer's page in headless Chromium, with all three renderers, and as a folder of static
//! files.
//!
//! Needs the offline models, and Chromium with its driver. Without them the tests are skipped with
//! a message, or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/browser.rs"]
mod browser;
#[path = "support/run.rs"]
mod run;
#[path = "support/served.rs"]
mod served;

use browser::Browser;
use fastlgs_core::image_io;
use image::RgbImage;
use run::{copy_folder, json, text};
use serde_json::Value;
use served::{Server, room};
use std::collections::BTreeSet;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Returns the window size. `--all` uses the size of the README's picture. Otherwise a smaller
/// window saves time.
fn window() -> (u32, u32) {
    if run::full_tests() {
        (1180, 740)
    } else {
        (860, 560)
    }
}

/// Returns the peak signal-to-noise ratio of two pictures of the same size, in dB.
fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let square: f64 = a
        .as_raw()
        .iter()
        .zip(b.as_raw())
        .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
        .sum();
    10.0 * (255.0f64.powi(2) / (square / a.as_raw().len() as f64).max(1e-9)).log10()
}

/// Returns the present picture of the canvas.
fn snapshot(browser: &Browser) -> RgbImage {
    let url = browser.run(
        "await fastlgs.stage.settle(); const blob = await fastlgs.stage.snapshot();
         return new Promise((done) => { const reader = new FileReader(); reader.onload = () => done(reader.result); reader.readAsDataURL(blob); });",
    );
    image_io::decode_rgb("canvas", &Browser::decode(&url)).expect("a PNG")
}

/// Returns the IoU of the server's mask and the highlighted pixels. Other pixels are dimmed
/// (`web/splat.wgsl`, `inside_image`).
fn lit_iou(plain: &RgbImage, marked: &RgbImage, mask: &RgbImage) -> f64 {
    let distance = |a: [f64; 3], b: [u8; 3]| {
        (0..3)
            .map(|k| (a[k] - f64::from(b[k])).powi(2))
            .sum::<f64>()
    };
    let (mut both, mut either) = (0, 0);
    for ((p, m), s) in plain.pixels().zip(marked.pixels()).zip(mask.pixels()) {
        let c = p.0.map(f64::from);
        let lit = distance([c[0] / 2.0 + 127.0, c[1] / 2.0 + 40.0, c[2] / 2.0], m.0)
            < distance(c.map(|v| v / 3.0), m.0);
        both += u32::from(lit && s[0] > 0);
        either += u32::from(lit || s[0] > 0);
    }
    f64::from(both) / f64::from(either.max(1))
}

/// Types a query by keys alone. Waits for the answer on the page and returns it.
fn type_text(browser: &Browser, what: &str) -> String {
    browser.keys("/");
    browser.run("document.getElementById('text').value = '';");
    browser.keys(&format!("{what}\u{e007}"));
    let message = "document.getElementById('answer').textContent";
    browser.wait_for(&format!(
        "{message}.includes('\"{what}\"') && {message}.includes(' ms)')"
    ));
    // Escape moves the focus from the text field to the picture.
    browser.keys("\u{e00c}");
    browser
        .run(&format!("return {message};"))
        .as_str()
        .expect("text")
        .to_owned()
}

fn chromium() -> bool {
    let there = browser::installed();
    if !there {
        assert!(
            std::env::var_os("FASTLGS_REQUIRE_GPU").is_none(),
            "chromium and chromedriver are missing"
        );
        run::skip("needs chromium and chromedriver");
    }
    there
}

/// Flags for WebGPU on Chromium's software Vulkan, for machines without a GPU.
const WEBGPU: [&str; 5] = [
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--use-angle=vulkan",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
];

/// Tests the page of a scene with one renderer. The query `word` highlights the pixels of its mask,
/// `absent` is not found, keys and mouse work.
fn page_works(
    served: &Server,
    renderer_name: &str,
    flags: &[&str],
    word: &str,
    absent: &str,
) -> Browser {
    let browser = Browser::open(window().0, window().1, flags);
    browser.go(&format!("{}/?renderer={renderer_name}", served.url));
    browser.wait_for("document.body.dataset.ready");
    assert_eq!(
        browser.run("return fastlgs.stage.renderer.name;"),
        renderer_name
    );
    let plain = snapshot(&browser);
    let camera = browser
        .run("return fastlgs.stage.camera.asJson(fastlgs.stage.width, fastlgs.stage.height);");
    let rendered = served.request(
        "/api/render",
        Some(&serde_json::json!({ "camera": camera }).to_string()),
    );
    let same = psnr(
        &plain,
        &image_io::decode_rgb("render", &rendered.1).expect("a PNG"),
    );
    let least = if renderer_name == "pictures" {
        25.0
    } else {
        32.0
    };
    assert!(
        same > least,
        "{renderer_name}: the PSNR of the browser's and the server's picture is only {same} dB"
    );

    let said = type_text(&browser, word);
    let answer = served.json(
        "/api/query",
        Some(serde_json::json!({ "text": word, "camera": camera, "mask": true })),
    );
    let named = match &answer["objects"].as_array().expect("objects")[..] {
        [one] => format!("#{}", one["id"]),
        several => format!("{} objects", several.len()),
    };
    assert!(said.contains(&named), "{said}: {answer}");
    let marked = snapshot(&browser);
    let mask = image_io::decode_rgb("mask", &Browser::decode(&answer["mask"])).expect("a PNG");
    let iou = lit_iou(&plain, &marked, &mask);
    println!(
        "{renderer_name}: {same:.1} dB to the server's picture; highlighted pixels and mask of \"{word}\" have an IoU of {iou:.3}"
    );
    assert!(
        iou > 0.8,
        "{renderer_name}: highlighted pixels and mask have an IoU of {iou}"
    );

    // A click on the object selects it, one of its parts, or an object that contains it.
    let at = |p: &[u32; 2]| mask.get_pixel(p[0], p[1])[0] > 0;
    let own: Vec<[u32; 2]> = (0..mask.width() * mask.height())
        .map(|p| [p % mask.width(), p / mask.width()])
        .filter(at)
        .collect();
    let page_position = |p: [u32; 2]| {
        let place = browser.run(&format!(
            "const box = fastlgs.stage.elements.canvas.getBoundingClientRect(); return [box.x + {} / fastlgs.stage.ratio, box.y + {} / fastlgs.stage.ratio];",
            p[0], p[1]
        ));
        [0, 1].map(|k| place[k].as_f64().expect("a number") as i32)
    };
    // A pixel may belong to no object: at the border of two objects, or behind a stray Gaussian.
    let selects = |p: [u32; 2]| {
        browser.keys("\u{e00c}");
        browser.drag(page_position(p), page_position(p));
        let selected = || {
            browser.run("await fastlgs.stage.settle(); return fastlgs.state.selected.size;") == 1
        };
        (0..10).any(|_| {
            std::thread::sleep(Duration::from_millis(200));
            selected()
        })
    };
    assert!(
        (8..16).any(|k| selects(own[own.len() * k / 16])),
        "{renderer_name}: no click on the object selects anything"
    );

    // Keys hide, show and isolate objects.
    browser.keys("x");
    browser.wait_for("fastlgs.state.hidden.size === 1 && fastlgs.state.selected.size === 0");
    let hidden = psnr(&snapshot(&browser), &plain);
    browser.keys("a");
    let back = psnr(&snapshot(&browser), &plain);
    assert!(
        back > 45.0,
        "{renderer_name}: the hidden object is shown again"
    );
    // A small object changes few pixels.
    assert!(
        hidden < back - 5.0,
        "{renderer_name}: hiding must change the picture: {hidden:.1} dB hidden, {back:.1} dB shown again"
    );
    // The list has all objects and parts, with their likeliest names.
    let objects = served.json("/api/objects", None);
    let count = objects.as_array().expect("objects").len();
    assert_eq!(
        browser
            .run("return document.querySelectorAll('#list button').length;")
            .as_u64(),
        Some(count.min(24) as u64),
        "{objects}"
    );
    browser.wait_for(
        "[...document.querySelectorAll('#list button')].some((b) => b.textContent.endsWith('?'))",
    );

    // Clicks with Shift held select one object together.
    browser.keys("\u{e00c}");
    let places = [4, 8, 12].map(|k| page_position(own[own.len() * k / 16]));
    browser.holding("\u{e008}", || {
        places
            .iter()
            .for_each(|[x, y]| browser.drag([*x, *y], [x + 1, *y]))
    });
    browser.wait_for(
        "document.getElementById('answer').textContent.startsWith('3 clicks on one object: #') && fastlgs.state.selected.size === 1",
    );
    browser.keys("\u{e00c}");

    // The page reports absent names.
    let said = type_text(&browser, absent);
    assert!(said.contains("not found"), "{said}");
    assert_eq!(browser.run("return fastlgs.state.selected.size;"), 0);
    browser.keys("\u{e00c}");

    // Keys, mouse and fingers move the camera. A key returns to a photo's view.
    let eye = || browser.run("return fastlgs.stage.camera.eye.map((v) => v.toFixed(4)).join();");
    let first = eye();
    browser.keys("\u{e012}\u{e013}");
    let turned = eye();
    assert_ne!(first, turned, "{renderer_name}: arrow keys turn");
    browser.drag([300, 300], [360, 330]);
    assert_ne!(turned, eye(), "{renderer_name}: the mouse turns");
    let distance = || {
        browser
            .run("return fastlgs.stage.camera.distance;")
            .as_f64()
            .expect("a number")
    };
    let before = distance();
    browser.pinch([300, 300], 40, 120);
    assert!(
        distance() < 0.6 * before,
        "{renderer_name}: spreading two fingers moves the camera closer"
    );
    browser.keys("][");
    assert_eq!(
        first,
        eye(),
        "{renderer_name}: keys step through the photos and return to the first view"
    );
    browser.keys("pc3");
    browser.wait_for(
        "!document.getElementById('photo').hidden && document.getElementById('photo').complete",
    );
    browser.keys("c");
    browser.run("await fastlgs.stage.settle();");
    assert_eq!(
        browser.run("return document.querySelector('#modes input:checked').value;"),
        "objects"
    );
    browser.keys("p1");
    assert_eq!(
        browser.errors(),
        Vec::<String>::new(),
        "{renderer_name}: the console has no errors"
    );
    browser
}

#[test]
fn a_text_highlights_its_object_with_every_renderer() {
    if !chromium() {
        return;
    }
    let Some(scene) = room() else { return };
    let served = Server::start(&["serve", text(scene), "--bind", "0", "--device", "cpu"]);
    page_works(&served, "webgpu", &WEBGPU, "cat", "pizza");
    page_works(&served, "pictures", &[], "cat", "pizza");
    let browser = page_works(
        &served,
        "webgl2",
        &["--enable-unsafe-swiftshader"],
        "cat",
        "pizza",
    );
    type_text(&browser, "cat");
    browser.run("await fastlgs.stage.settle();");
    std::thread::sleep(Duration::from_millis(500));
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("viewer.png");
    browser.screenshot(&path);
    println!("picture of the page for the README: {}", path.display());
    // Without a `renderer` parameter, a browser without a GPU shows the server's pictures.
    browser.go(&served.url);
    browser.wait_for("document.body.dataset.ready");
    assert_eq!(
        browser.run("return fastlgs.stage.renderer.name;"),
        "pictures"
    );
}

#[test]
fn objects_are_named_measured_and_shared_by_link() {
    if !chromium() {
        return;
    }
    let Some(scene) = room() else { return };
    let names = tempfile::tempdir().expect("a temporary folder");
    let served = Server::start_with_names(
        names.path(),
        &["serve", text(scene), "--bind", "0", "--device", "cpu"],
    );
    let browser = Browser::open(window().0, window().1, &["--enable-unsafe-swiftshader"]);
    let open = |address: &str| {
        browser.go(address);
        browser.wait_for("document.body.dataset.ready");
    };
    open(&format!("{}/?renderer=webgl2", served.url));
    let said = || {
        browser
            .run("return document.getElementById('answer').textContent;")
            .as_str()
            .expect("text")
            .to_owned()
    };
    let ids = || browser.run("return [...fastlgs.state.selected];");

    // Keys name the object that a query found. Page and interface know the name at once.
    type_text(&browser, "cat");
    let cat = ids();
    assert_eq!(cat.as_array().expect("ids").len(), 1, "{cat}");
    browser.keys("nMruczek\u{e007}");
    browser.wait_for(
        "document.getElementById('answer').textContent.includes('is called \"mruczek\"')",
    );
    browser.keys("\u{e00c}");
    type_text(&browser, "mruczek");
    assert_eq!(ids(), cat, "{}", said());
    let names = served.json("/api/names", None);
    assert!(
        names
            .as_array()
            .expect("names")
            .contains(&Value::from("mruczek")),
        "{names}"
    );
    let taught = |body: &str, status| served.refusal("/api/names", Some(body), status);
    assert!(taught(r#"{"name":" ","object":1}"#, 400).contains("empty"));
    assert!(taught(r#"{"name":"a","object":60000}"#, 404).contains("60000"));
    assert!(taught(r#"{"name":"a"}"#, 422).contains("object"));

    // Earlier queries are suggested, the latest first, also after the page is reloaded.
    let offered = || {
        browser.run("return [...document.querySelectorAll('#recent option')].map((o) => o.value).slice(0, 2);")
    };
    assert_eq!(offered(), serde_json::json!(["mruczek", "cat"]));

    // If the camera looks away, the page moves to the view that shows the target best.
    browser.run(
        "const { camera } = fastlgs.stage, pose = camera.pose();
         camera.stand(pose.map((v, k) => (k > 2 && k < 6 ? 2 * pose[k - 3] - v : v)));
         await fastlgs.stage.settle();",
    );
    let led = type_text(&browser, "cat");
    assert!(led.contains("seen best in"), "{led}");
    let pixels: usize = led
        .split(" pixels here")
        .next()
        .and_then(|s| s.rsplit(", ").next())
        .and_then(|n| n.parse().ok())
        .unwrap_or(9999);
    assert!(pixels > 100, "{led}");
    assert_eq!(browser.run("return fastlgs.stage.camera.moved;"), false);

    // A link restores the camera, the display mode and the selection.
    browser.run("fastlgs.stage.camera.turn(0.2, 0.1); fastlgs.stage.camera.zoom(0.9);");
    browser.keys("2l");
    browser.wait_for("document.getElementById('answer').textContent.includes('link to this view')");
    let pose = || -> Vec<f64> {
        let pose = browser.run("return fastlgs.stage.camera.pose();");
        pose.as_array()
            .expect("numbers")
            .iter()
            .filter_map(Value::as_f64)
            .collect()
    };
    let (address, before) = (browser.run("return location.href;"), pose());
    let address = address.as_str().expect("an address").to_owned();
    browser.go("about:blank");
    open(&address);
    assert!(
        before.iter().zip(pose()).all(|(a, b)| (a - b).abs() < 1e-3),
        "{address}: {before:?}, {:?}",
        pose()
    );
    assert_eq!(ids(), cat, "{address}");
    assert_eq!(
        browser.run("return document.querySelector('#modes input:checked').value;"),
        "relevancy",
        "{address}"
    );
    assert_eq!(offered(), serde_json::json!(["cat", "mruczek"]));
    browser.run("location.hash = '#view=nowhere.png';");
    browser.wait_for("document.getElementById('problem').textContent.includes('\"nowhere.png\"')");

    // Two clicks measure a length. The points have the depth of the scene, with any renderer.
    browser.keys("\u{e00c}1m");
    browser.drag([150, 200], [150, 200]);
    browser.wait_for("fastlgs.stage.measure.points.length === 1");
    browser.drag([350, 260], [350, 260]);
    browser.wait_for("document.getElementById('length').textContent.includes(' units')");
    let apart = || {
        browser.run("const [a, b] = fastlgs.stage.measure.points; return Math.hypot(...a.map((v, k) => v - b[k]));")
    };
    let units = apart().as_f64().expect("a length");
    browser.run(
        "const metres = document.getElementById('metres'); metres.value = '2.5'; metres.dispatchEvent(new Event('change'));
         await fastlgs.stage.settle();",
    );
    assert_eq!(
        browser.run("return document.getElementById('length').textContent;"),
        "2.5 m"
    );
    browser.drag([350, 260], [350, 260]);
    browser.wait_for("fastlgs.stage.measure.points.length === 1");
    browser.drag([150, 200], [150, 200]);
    browser.wait_for("document.getElementById('length').textContent === '2.5 m'");
    assert!((apart().as_f64().expect("a length") - units).abs() < 1e-6);
    // Measuring selects nothing. Escape ends it.
    assert_eq!(browser.run("return fastlgs.state.selected.size;"), 0);
    browser.keys("\u{e00c}");
    assert_eq!(browser.run("return fastlgs.stage.measure.on;"), false);
    browser.run("fastlgs.stage.lookFrom(0);");
    let photos = &run::room().expect("the room").photos;
    let view = browser.run("return fastlgs.stage.camera.view.name;");
    let truth = photos
        .join("depth")
        .join(format!("{}.exr", view.as_str().expect("a name")));
    let (width, height, truth) =
        fastlgs_core::exr_image::read(&truth).expect("the room's own depth");
    let places: Vec<[usize; 2]> = (1..8)
        .flat_map(|y| (1..8).map(move |x| [width * x / 8, height * y / 8]))
        .collect();
    let deep = browser.run(&format!(
        "const {{ stage }} = fastlgs, lens = stage.camera.lens(stage.width, stage.height), {{ left, top, width }} = lens.picture;
         const near = [];
         for (const [x, y] of {}) {{
           const point = await stage.point(left + (x + 0.5) * width / {width}, top + (y + 0.5) * width / {width});
           near.push(point && point.reduce((sum, v, k) => sum + (v - stage.camera.eye[k]) * stage.camera.forward[k], 0));
         }}
         return near;",
        serde_json::to_string(&places).expect("JSON")
    ));
    let off = |(p, z): (&[usize; 2], &Value)| {
        let truth = f64::from(truth[0].1[p[1] * width + p[0]]);
        (z.as_f64().unwrap_or(f64::INFINITY) / truth - 1.0).abs()
    };
    let mut errors: Vec<f64> = places
        .iter()
        .zip(deep.as_array().expect("depths"))
        .map(off)
        .collect();
    errors.sort_by(f64::total_cmp);
    println!(
        "relative error of measured depths: median {:.2} %, 90th percentile {:.1} %",
        100.0 * errors[24],
        100.0 * errors[44]
    );
    assert!(errors[24] < 0.02 && errors[44] < 0.15, "{errors:?}");

    // Messages on the page have rounded, grouped numbers.
    let sentences = browser.run(
        "const { readable } = await import(new URL('sentence.js', location.href));
         return ['8388608 bytes, 0.6000000238 of 2000x1500', '0027.jpg and \"20000\" stay; 12345.678'].map(readable);",
    );
    assert_eq!(
        sentences,
        serde_json::json!([
            "8,388,608 bytes, 0.6 of 2,000 x 1,500",
            "0027.jpg and \"20000\" stay; 12,300"
        ])
    );
    assert_eq!(
        browser.errors(),
        Vec::<String>::new(),
        "nothing on the console"
    );
}

#[test]
fn a_large_scene_appears_within_seconds() {
    const GAUSSIANS: usize = 100_000;
    if !chromium() {
        return;
    }
    let Some(scene) = room() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let large = dir.path().join("large");
    copy_folder(scene, &large);
    let folder = fastlgs_core::SceneFolder::new(&large);
    let room = folder.gaussians().expect("the room");
    let many = room.select(&(0..GAUSSIANS).map(|i| i % room.len()).collect::<Vec<_>>());
    fastlgs_core::ply::write(&folder.ply_path(), &many).expect("a file");
    let served = Server::start(&["serve", text(&large), "--bind", "0", "--device", "cpu"]);
    for (way, flags) in [
        ("pictures", &[][..]),
        ("webgl2", &["--enable-unsafe-swiftshader"][..]),
    ] {
        // A new browser each time, with an empty cache.
        let seen = || {
            let browser = Browser::open(window().0, window().1, flags);
            browser.go(&format!("{}/?renderer={way}", served.url));
            browser.wait_for("window.fastlgs?.stage.firstPicture");
            browser
                .run("return fastlgs.stage.firstPicture;")
                .as_f64()
                .expect("milliseconds")
        };
        // The promised limit is two seconds. Parallel tests can slow this down, so the best of
        // three may take four.
        let ms = (0..3).map(|_| seen()).fold(f64::INFINITY, f64::min);
        println!("{way}: first picture of {GAUSSIANS} Gaussians after {ms:.0} ms");
        assert!(ms < 4000.0, "{way}: {ms} ms");
    }
}

/// A file server. Dropping this value ends it.
struct Files(Child);

impl Files {
    /// Serves a folder. Returns the server and its address.
    fn of(folder: &Path) -> (Self, String) {
        let port = std::net::TcpListener::bind("127.0.0.1:0")
            .and_then(|l| l.local_addr())
            .expect("a free port")
            .port();
        let mut command = Command::new("python3");
        command.args([
            "-m",
            "http.server",
            &port.to_string(),
            "--bind",
            "127.0.0.1",
            "-d",
            text(folder),
        ]);
        let files = Self(
            command
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .expect("python3 starts"),
        );
        let began = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(
                began.elapsed() < Duration::from_secs(20),
                "the file server does not answer"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
        (files, format!("http://127.0.0.1:{port}"))
    }
}

impl Drop for Files {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn an_exported_page_answers_on_a_static_server() {
    if !chromium() {
        return;
    }
    let Some(scene) = room() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let page = dir.path().join("my page");
    let share = |words: &str| {
        json(&[
            "export",
            text(scene),
            text(&page),
            "--html",
            "--words",
            words,
            "--device",
            "cpu",
        ])
    };
    assert_eq!(share("40")["words"], 40);
    // A second export replaces the first.
    let report = share(if run::full_tests() { "20000" } else { "6000" });
    println!("shared: {report}");
    assert!(
        report["words"].as_u64() >= Some(6000) && report["found"].as_u64() > Some(0),
        "{report}"
    );
    assert!(report["bytes"].as_u64() < Some(6_000_000), "{report}");
    // A folder with other files is not replaced.
    let other = dir.path().join("other");
    std::fs::create_dir(&other)
        .and_then(|()| std::fs::write(other.join("letter.txt"), "dear"))
        .expect("a folder");
    run::assert_fails(
        &["export", text(scene), text(&other), "--html"],
        &["holds no exported page"],
    );
    assert!(other.join("letter.txt").is_file());

    // Serves the page in a subfolder of the site, as GitHub Pages does for projects.
    let (_files, url) = Files::of(dir.path());
    let browser = Browser::open(window().0, window().1, &["--enable-unsafe-swiftshader"]);
    browser.go(&format!("{url}/my%20page/"));
    browser.wait_for("document.body.dataset.ready");
    assert_eq!(
        browser.run("return fastlgs.stage.renderer.name;"),
        "webgl2",
        "a static folder has no server that renders"
    );
    let plain = snapshot(&browser);
    let answer = json(&["query", text(scene), "cat", "--device", "cpu"]);
    let ids: BTreeSet<u64> = answer["objects"]
        .as_array()
        .expect("objects")
        .iter()
        .filter_map(|o| o["id"].as_u64())
        .collect();
    let said = type_text(&browser, "cat");
    let selected = browser.run("return [...fastlgs.state.selected];");
    assert_eq!(
        selected
            .as_array()
            .expect("ids")
            .iter()
            .filter_map(Value::as_u64)
            .collect::<BTreeSet<_>>(),
        ids,
        "{said}: {answer}"
    );
    assert!(
        psnr(&plain, &snapshot(&browser)) < 25.0,
        "the cat is highlighted"
    );
    assert!(type_text(&browser, "tricycle").contains("not found"));
    browser.keys("/");
    browser.run("document.getElementById('text').value = '';");
    browser.keys("striped catt\u{e007}");
    // The message disappears after a few seconds, but its text stays in the document.
    browser.wait_for("document.getElementById('problem').textContent.includes('catt')");
    let said = browser.run("return document.getElementById('problem').textContent;");
    assert!(
        said.as_str()
            .is_some_and(|said| said.contains("\"striped catt\" is not among them")
                && said.contains("similar words:")),
        "{said}"
    );
    browser.keys("\u{e00c}");
    browser.wait_for("document.querySelector('#list img').naturalWidth > 0");
    assert_eq!(browser.run("return document.getElementById('exports').hidden && document.getElementById('compare').hidden;"), true);
    assert_eq!(
        browser.errors(),
        Vec::<String>::new(),
        "nothing on the console"
    );
}

#[test]
#[ignore = "minutes; ./test.sh --all runs it"]
fn the_fox_is_highlighted_in_the_browser() {
    let photos = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/fox");
    if !photos.is_dir() {
        run::skip(format_args!("{} is not there", photos.display()));
        return;
    }
    if !chromium() || !run::requirements_met() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let scene = dir.path().join("fox");
    let half = dir.path().join("few");
    // The short run uses every second photo.
    let photos = if run::full_tests() {
        photos
    } else {
        every_second(&photos, &half)
    };
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--max-side",
        "320",
    ]);
    json(&[
        "train",
        text(&scene),
        "--iterations",
        "700",
        "--budget",
        "30000",
        "--device",
        "cpu",
    ]);
    let served = Server::start(&["serve", text(&scene), "--bind", "0", "--device", "cpu"]);
    page_works(
        &served,
        "webgl2",
        &["--enable-unsafe-swiftshader"],
        "fox",
        "bicycle",
    );
    let page = json(&[
        "export",
        text(&scene),
        text(&dir.path().join("page")),
        "--html",
        "--words",
        "500",
        "--device",
        "cpu",
    ]);
    println!("the fox as a folder: {page}");
    assert!(
        page["bytes"].as_u64() < Some(9_000_000),
        "the page is too large: {page}"
    );
}

/// Copies every second photo with its pose into a folder, and returns the folder.
fn every_second(photos: &Path, to: &Path) -> PathBuf {
    let text = std::fs::read(photos.join("transforms.json")).expect("poses");
    let mut poses: Value = serde_json::from_slice(&text).expect("JSON");
    let frames = poses["frames"].as_array_mut().expect("frames");
    frames.retain(|f| {
        photos
            .join(f["file_path"].as_str().expect("a path"))
            .is_file()
    });
    let mut place = 0;
    frames.retain(|_| {
        place += 1;
        place % 2 == 1
    });
    std::fs::create_dir_all(to.join("images")).expect("a folder");
    for frame in frames.iter() {
        let path = frame["file_path"].as_str().expect("a path");
        std::fs::copy(photos.join(path), to.join(path)).expect("a photo");
    }
    std::fs::write(to.join("transforms.json"), poses.to_string()).expect("a file");
    to.to_owned()
}
