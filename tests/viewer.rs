//! The viewer's HTTP interface, used like a program would.
//!
//! Needs the offline models. Without them the tests are skipped with a message, or fail if
//! FASTLGS_REQUIRE_GPU is set.

#[path = "support/run.rs"]
mod run;
#[path = "support/served.rs"]
mod served;

use fastlgs_core::image_io;
use run::{copy_folder, json, text};
use serde_json::Value;
use served::{Server, room};
use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::time::{Duration, Instant};

fn keys(value: &Value) -> BTreeSet<&str> {
    value
        .as_object()
        .unwrap_or_else(|| panic!("no object: {value}"))
        .keys()
        .map(String::as_str)
        .collect()
}

#[test]
fn the_interface_answers_as_the_query_command_does() {
    let Some(scene) = room() else { return };
    let served = Server::start(&["serve", text(scene), "--bind", "0", "--device", "cpu"]);
    let mut answer = served.json(
        "/api/query",
        Some(serde_json::json!({ "text": "cat", "view": "008.png" })),
    );
    let mut own = json(&[
        "query",
        text(scene),
        "cat",
        "--view",
        "008.png",
        "--device",
        "cpu",
    ]);
    for value in [&mut answer, &mut own] {
        assert!(
            value["ms"]["total"].as_f64().is_some_and(|ms| ms > 0.0),
            "{value}"
        );
        value["ms"]
            .as_object_mut()
            .expect("milliseconds")
            .values_mut()
            .for_each(|ms| *ms = Value::Null);
    }
    assert_eq!(answer, own);
    assert_eq!(answer["found"], true);

    // The OpenAPI document lists all addresses and all fields of the answers.
    let document = served.json("/api/openapi.json", None);
    let schema = |path: &str, method: &str| {
        document["paths"][path][method]["responses"]["200"]["content"]["application/json"]["schema"]
            .clone()
    };
    let scene_facts = served.json("/api/scene", None);
    let objects = served.json("/api/objects", None);
    assert_eq!(
        keys(&schema("/api/query", "post")["properties"]),
        keys(&answer)
    );
    assert_eq!(
        keys(&schema("/api/query", "post")["properties"]["objects"]["items"]["properties"]),
        keys(&answer["objects"][0])
    );
    assert_eq!(
        keys(&schema("/api/scene", "get")["properties"]),
        keys(&scene_facts)
    );
    assert_eq!(
        keys(&schema("/api/scene", "get")["properties"]["views"]["items"]["properties"]),
        keys(&scene_facts["views"][0])
    );
    assert_eq!(
        keys(&schema("/api/objects", "get")["items"]["properties"]),
        keys(&objects[0])
    );
    let names = served.json("/api/objects/names", None);
    assert_eq!(
        names.as_array().map(Vec::len),
        objects.as_array().map(Vec::len)
    );
    let name = schema("/api/objects/names", "get")["items"]["items"]["properties"].clone();
    assert_eq!(keys(&name), keys(&names[0][0]));
    let by_id = serde_json::json!({ "object": answer["objects"][0]["id"], "view": "008.png" });
    let by_id = served.json("/api/query", Some(by_id));
    assert_eq!(by_id["objects"][0]["id"], answer["objects"][0]["id"]);
    for (path, methods) in document["paths"].as_object().expect("paths") {
        let path = path
            .replace("{id}", "1")
            .replace("{view}", "008.png")
            .replace("/api/training", "/api/scene");
        let path = if path == "/api/export" {
            format!("{path}?objects=1&format=glb")
        } else {
            path
        };
        // Another test teaches names.
        let body = methods
            .get("post")
            .filter(|_| methods.get("get").is_none())
            .map(|_| {
                r#"{"text":"cat","what":"heatmap"}"#.replace(
                    r#","what":"heatmap""#,
                    if path.ends_with("render") {
                        r#","what":"heatmap""#
                    } else {
                        ""
                    },
                )
            });
        let (status, data) = served.request(&path, body.as_deref());
        assert_eq!(
            status,
            200,
            "{path}: {}",
            String::from_utf8_lossy(&data[..data.len().min(200)])
        );
    }
    // The number of Gaussians includes the object's parts, as in the answer of a query.
    let id = answer["objects"][0]["id"].as_u64().expect("an id") as usize;
    assert_eq!(
        objects[id - 1]["gaussians"],
        answer["objects"][0]["gaussians"]
    );
    assert!(
        served
            .request(&format!("/api/export?objects={id}&format=ply"), None)
            .1
            .starts_with(b"ply\n")
    );
    let picture = |body: &str| {
        let (status, data) = served.request("/api/render", Some(body));
        assert_eq!(
            status,
            200,
            "{}",
            String::from_utf8_lossy(&data[..data.len().min(200)])
        );
        image_io::decode_rgb("render", &data).expect("a PNG")
    };
    let whole = picture(r#"{"view":"008.png"}"#);
    assert_eq!(whole.dimensions(), (320, 240));
    assert_eq!(
        picture(r#"{"view":"008.png","size":"160x120"}"#).dimensions(),
        (160, 120)
    );
    assert_ne!(
        picture(&format!(r#"{{"view":"008.png","hidden":[{id}]}}"#)),
        whole
    );
    assert_eq!(
        picture(r#"{"view":"008.png"}"#),
        whole,
        "the hidden object is shown again"
    );

    // Errors are one sentence.
    let long = format!(r#"{{"text":"{}"}}"#, "x".repeat(301));
    let huge = format!(r#"{{"image":"{}"}}"#, "A".repeat(9 << 20));
    for (path, body, status, word) in [
        ("/api/query", "{", 400, "JSON"),
        (
            "/api/query",
            "{}",
            400,
            "one of text, point, image and object",
        ),
        ("/api/query", r#"{"text":" "}"#, 400, "empty"),
        ("/api/query", long.as_str(), 400, "301 characters"),
        ("/api/query", r#"{"txt":"cat"}"#, 422, "txt"),
        (
            "/api/query",
            r#"{"text":"cat","view":"nowhere"}"#,
            400,
            "nowhere",
        ),
        (
            "/api/query",
            r#"{"text":"cat","size":"9000x9000"}"#,
            400,
            "too large",
        ),
        ("/api/query", r#"{"point":[999,3]}"#, 400, "outside"),
        ("/api/query", r#"{"point":[[1,3],[999,3]]}"#, 400, "outside"),
        ("/api/query", r#"{"point":[]}"#, 422, "no pixel"),
        ("/api/query", r#"{"image":"AAAA"}"#, 400, "cannot be read"),
        ("/api/query", huge.as_str(), 413, "large"),
        ("/api/render", r#"{"what":"smell"}"#, 400, "smell"),
        (
            "/api/render",
            r#"{"only":[60000]}"#,
            400,
            "nothing would be left",
        ),
        ("/api/scene", "{}", 405, "openapi"),
    ] {
        let message = served.refusal(path, Some(body), status);
        assert!(
            message.to_lowercase().contains(&word.to_lowercase()),
            "{path}: '{message}' lacks '{word}'"
        );
    }
    assert!(
        served
            .refusal("/api/nothing", None, 404)
            .contains("openapi")
    );
    assert!(
        served
            .refusal("/api/training", None, 404)
            .contains("not trained here")
    );
    assert!(
        served
            .refusal("/api/objects/60000/thumbnail.png", None, 404)
            .contains("60000")
    );
    assert!(
        served
            .refusal("/api/photos/..%2Fscene.json", None, 404)
            .contains("scene.json"),
        "only photos of views are served"
    );
    assert!(
        served
            .refusal("/api/export?objects=1&format=doc", None, 400)
            .contains("doc")
    );

    // Too many simultaneous requests get status 503. The others are answered, and so are later
    // ones.
    let statuses: Vec<u16> = std::thread::scope(|scope| {
        let work = |k: usize| {
            served
                .request(
                    "/api/query",
                    Some(&format!(
                        r#"{{"text":"thing {k}","size":"{}x240"}}"#,
                        300 + k
                    )),
                )
                .0
        };
        let threads: Vec<_> = (0..100).map(|k| scope.spawn(move || work(k))).collect();
        threads
            .into_iter()
            .map(|t| t.join().expect("no panic"))
            .collect()
    });
    let count = |status: u16| statuses.iter().filter(|s| **s == status).count();
    assert!(
        count(200) >= 32 && count(200) + count(503) == 100,
        "{statuses:?}"
    );
    println!(
        "100 simultaneous queries: {} answered, {} refused with status 503",
        count(200),
        count(503)
    );
    assert_eq!(
        served.json("/api/query", Some(serde_json::json!({ "text": "cat" })))["found"],
        true
    );
}

#[test]
fn unauthorised_requests_are_refused() {
    let Some(scene) = room() else { return };
    let host = |served: &Server, host: &str| {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .build()
            .into();
        agent
            .get(&format!("{}/api/scene", served.url))
            .header("Host", host)
            .call()
            .expect("an answer")
            .status()
            .as_u16()
    };
    let own = Server::start(&[
        "serve",
        text(scene),
        "--bind",
        "127.0.0.1:0",
        "--device",
        "cpu",
    ]);
    assert!(own.token.is_none());
    assert_eq!(
        (
            host(&own, "localhost:80"),
            host(&own, "[::1]:80"),
            host(&own, "evil.example")
        ),
        (200, 200, 403)
    );

    // A proxy on this machine that passes its own host name on.
    let behind = Server::start(&[
        "serve",
        text(scene),
        "--bind",
        "127.0.0.1:0",
        "--device",
        "cpu",
        "--host-name",
        "scenes.example",
    ]);
    assert_eq!(
        (
            host(&behind, "scenes.example"),
            host(&behind, "localhost"),
            host(&behind, "evil.example")
        ),
        (200, 200, 403)
    );

    let mut open = Server::start(&[
        "serve",
        text(scene),
        "--bind",
        "0.0.0.0:0",
        "--device",
        "cpu",
    ]);
    open.url = open.url.replace("0.0.0.0", "127.0.0.1");
    let token = open.token.clone().expect("a token");
    assert_eq!(token.len(), 32);
    assert_eq!(open.json("/api/scene", None)["name"], "room");
    assert_eq!(open.request("/", None).0, 200);
    for wrong in [
        None,
        Some(String::new()),
        Some(token[..31].to_owned()),
        Some("0".repeat(32)),
    ] {
        open.token = wrong;
        assert!(open.refusal("/api/scene", None, 401).contains("token"));
    }
    assert_eq!(
        open.request(&format!("/api/scene?token={token}"), None).0,
        200
    );

    // A refused client receives the reason even while it is still sending.
    let mut stranger =
        TcpStream::connect(open.url.trim_start_matches("http://")).expect("a connection");
    let head = "POST /api/query HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: 2000000\r\n\r\n";
    stranger
        .write_all(head.as_bytes())
        .expect("the head is taken");
    for _ in 0..20 {
        std::thread::sleep(Duration::from_millis(20));
        stranger
            .write_all(&[b' '; 100_000])
            .expect("the server reads the body");
    }
    let mut said = String::new();
    stranger.read_to_string(&mut said).expect("an answer");
    assert!(
        said.starts_with("HTTP/1.1 401") && said.contains("the token is missing"),
        "{said}"
    );
}

#[test]
fn a_training_scene_is_served() {
    let Some(scene) = room() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let copy = dir.path().join("growing");
    copy_folder(scene, &copy);
    let mut served = Server::start(&[
        "train",
        text(&copy),
        "--iterations",
        "400",
        "--budget",
        "8000",
        "--device",
        "cpu",
        "--curve",
        "200",
        "--serve=0",
        "-q",
    ]);
    let began = Instant::now();
    let mut revisions = BTreeSet::new();
    let is_ready = || served.json("/api/scene", None)["stage"] == "ready";
    while !is_ready() {
        let progress = served.json("/api/training", None);
        revisions.insert(progress["revision"].as_u64());
        let (status, splats) = served.request("/api/splats", None);
        assert!(status == 200 && splats.starts_with(b"FLGS"));
        if progress["finished"] == false {
            // On a fast or busy machine, the run may finish between two requests.
            let (status, said) = served.request("/api/query", Some(r#"{"text":"cat"}"#));
            let refused = status == 409 && String::from_utf8_lossy(&said).contains("in training");
            assert!(refused || is_ready(), "{status}");
        }
        assert!(began.elapsed() < Duration::from_secs(300));
        std::thread::sleep(Duration::from_millis(300));
    }
    let last = served.json("/api/training", None);
    revisions.insert(last["revision"].as_u64());
    assert!(
        revisions.len() > 1,
        "the scene changed too rarely: revisions {revisions:?}"
    );
    let curve = last["curve"].as_array().expect("a curve");
    assert_eq!(curve.last().expect("points")["iteration"], 400);
    assert_eq!(
        curve
            .iter()
            .filter(|p| p["psnr_held_out"].is_number())
            .count(),
        2
    );
    let rises = |name: &str| curve.last().expect("points")[name].as_f64() > curve[0][name].as_f64();
    assert!(rises("psnr") && !rises("loss"), "{curve:?}");
    assert_eq!(
        served.json("/api/query", Some(serde_json::json!({ "text": "cat" })))["found"],
        true
    );
    // The process ends without an error when it is terminated.
    let id = served.process.id().to_string();
    assert!(
        Command::new("kill")
            .arg(&id)
            .status()
            .expect("kill")
            .success()
    );
    assert!(served.process.wait().expect("it ends").success());
}
