//! The quick suite of benches on generated scenes: that they run, that their figures add up, and the bounds that are promised. Of the
//! rows that take longest only some, unless everything is tested.

#[path = "support/browser.rs"]
mod browser;
#[path = "support/run.rs"]
mod run;

use run::{json, text};
use serde_json::Value;
use std::path::Path;
use std::time::Instant;

fn number(row: &Value, name: &str) -> f64 {
    row[name].as_f64().unwrap_or_else(|| panic!("no {name} in {row}"))
}

fn written(folder: &Path, files: &[&str]) {
    for file in files {
        assert!(std::fs::metadata(folder.join(file)).unwrap_or_else(|e| panic!("{file}: {e}")).len() > 100, "{file}");
    }
    assert!(!folder.join(".trials").exists(), "trials are cleaned away");
}

#[test]
fn quick_suite() {
    if !run::ready() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let out = dir.path();
    let mut began = Instant::now();
    let mut lap = |what: &str| println!("{what}: {:.0} s", std::mem::replace(&mut began, Instant::now()).elapsed().as_secs_f64());
    let bench = |what: &str, scene: &[&str], dose: &[&str]| {
        let quick = ["bench", what, "--quick", "--device", "cpu", "-o", text(out)];
        json(&[&quick[..], scene, if run::all() { &[] } else { dose }].concat())
    };
    // Photos and masks for all but one, which makes its own; chart and paper keep its Gaussians as well.
    let (photos, table) = (out.join("photos"), out.join("table"));
    json(&["synth", "table", "-o", text(&photos), "--views", "32", "--size", "240x180"]);
    json(&["preprocess", text(&photos), "-o", text(&table), "--segmenter", "import", "--device", "cpu"]);
    json(&["train", text(&table), "--iterations", "1000", "--device", "cpu"]);
    let table = text(&table);
    lap("a trained scene");

    let chart = bench("chart", &[table], &["--ways", "embeddings,global,no grid,paper 300 steps"]);
    let rows = chart["rows"].as_array().expect("rows");
    let oracle = |way: &str| number(rows.iter().find(|r| r["way"] == way).expect("a way"), "oracle_miou");
    println!(
        "chart: {} ways, global {:.3}, embeddings {:.3}, no grid {:.3}",
        rows.len(),
        oracle("global"),
        oracle("embeddings"),
        oracle("no grid")
    );
    assert!(oracle("global") > 0.75 && oracle("global") > oracle("embeddings") && oracle("global") > oracle("no grid"), "{chart}");
    assert!(rows.iter().any(|r| r["pareto"] == true) && rows.iter().all(|r| number(r, "seconds") > 0.0));
    written(out, &["chart.svg", "chart.png", "chart-query.svg", "chart.md", "chart.csv", "chart.json"]);
    lap("chart");

    let few = ["--ways", "matching: embeddings,matching: + colour,all: as the paper"];
    let paper = ["bench", "paper", table, "--iterations", "500", "--device", "cpu", "-o", text(out)];
    let paper = json(&[&paper[..], if run::all() { &[] } else { &few }].concat());
    let row = |way: &str| paper["rows"].as_array().expect("rows").iter().find(|r| r["way"] == way).expect("a way").clone();
    let oracle = |way: &str| number(&row(way), "oracle_miou");
    let (embeddings, matching, all) = (oracle("matching: embeddings"), oracle("matching: + colour"), oracle("all: as the paper"));
    println!("paper: embeddings {embeddings:.3}, with key points and colour {matching:.3}, trained with the scene {all:.3}");
    assert!(matching > embeddings && matching > 0.8 && all > 0.45 && number(&row("all: as the paper"), "large_ms") > 0.0, "{paper}");
    written(out, &["paper.md", "paper.csv", "paper.json"]);
    lap("paper");

    let size = bench("size", &[], &["--iterations", "400"]);
    let verdict = &size["auto"][0];
    println!("size: {verdict}");
    // So short a run differs by 1.5 dB from seed to seed.
    assert!(number(verdict, "gaussians") < 1.0 && number(verdict, "lost_db") < 4.0, "{verdict}");
    let rows = size["rows"].as_array().expect("rows");
    let bytes = |model: &str| number(rows.iter().find(|r| r["model"] == model).expect("a model"), "scene_bytes");
    assert!(bytes("auto, compact") < bytes("auto") && bytes("degree 0") < bytes("full"));
    written(out, &["size.json", "size-psnr.svg", "size-oracle-miou.png"]);
    lap("size");

    let stability = bench("stability", &[table], &["--cases", "photos shuffled,masks split,masks dropped"]);
    let rows = stability["rows"].as_array().expect("rows");
    let row = |disturbance: &str| rows.iter().find(|r| r["disturbance"] == disturbance).expect("a row");
    println!("stability: {} rows hold, {} fail", stability["holds"], stability["fails"]);
    for row in rows {
        println!(
            "stability: {} {} {}: {:+.1} of {} ({})",
            row["scene"],
            row["disturbance"],
            row["strength"],
            number(row, "change"),
            row["bound"],
            row["verdict"]
        );
    }
    // What is promised; the other rows are measured.
    for promised in ["photos shuffled", "masks split", "masks dropped"] {
        assert_eq!(row(promised)["verdict"], "holds", "{}", row(promised));
    }
    let twins = rows.iter().find(|r| r["scene"] == "twins").expect("twins");
    assert!(number(twins, "apart") >= 0.95, "{twins}");
    written(out, &["stability.md", "stability-table.svg", "stability-table.png"]);
    lap("stability");

    let report = json(&["bench", "report", text(out), "-o", text(&out.join("report.html"))]);
    assert_eq!(report["results"].as_array().map(Vec::len), Some(4));
    let page = std::fs::read_to_string(out.join("report.html")).expect("the report");
    assert!(page.matches("<svg").count() == 5 && page.contains("photos shuffled") && !page.contains("src=\"http"), "self-contained");
    if browser::installed() {
        let browser = browser::Browser::open(900, 700, &[]);
        browser.go(&format!("file://{}", text(&out.join("report.html"))));
        let drawn = browser.run("return [...document.querySelectorAll('img, svg')].filter((p) => p.getBoundingClientRect().width > 0 && (p.naturalWidth ?? 1) > 0).length;");
        let all = browser.run("return document.querySelectorAll('img, svg').length;");
        assert!(all.as_u64() >= Some(5) && drawn == all, "{drawn} of {all} pictures are drawn");
        assert_eq!(browser.errors(), Vec::<String>::new(), "nothing on the console");
    } else {
        assert!(std::env::var_os("FASTLGS_REQUIRE_GPU").is_none(), "chromium and chromedriver are missing");
        eprintln!("SKIPPED: the report is not opened: needs chromium and chromedriver");
    }
}
