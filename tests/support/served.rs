//! A running `fastlgs serve` or `train --serve`, and its scene.
// Not every test program uses all functions.
#![allow(dead_code)]

use serde_json::Value;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Returns the scene folder of the shared room. `None` without models or device.
pub fn room() -> Option<&'static Path> {
    super::run::room().map(|room| room.scene.as_path())
}

/// A running `fastlgs serve` or `train --serve`. Dropping this value ends it.
pub struct Server {
    pub process: Child,
    /// URL of the server without a path.
    pub url: String,
    pub token: Option<String>,
}

impl Server {
    pub fn start(args: &[&str]) -> Self {
        Self::start_with_names(&super::run::data(), args)
    }

    /// Starts the program with the taught names of the folder `names`.
    pub fn start_with_names(names: &Path, args: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fastlgs"));
        let command = command
            .args(args)
            .env("FASTLGS_DATA", names)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut process = command.expect("the binary starts");
        let out: Box<dyn Read + Send> = match args[0] {
            "serve" => Box::new(process.stdout.take().expect("piped")),
            _ => Box::new(process.stderr.take().expect("piped")),
        };
        let mut lines = BufReader::new(out).lines().map_while(Result::ok);
        let address = lines
            .find_map(|l| {
                l.split_whitespace()
                    .find(|w| w.starts_with("http://"))
                    .map(str::to_owned)
            })
            .expect("an address");
        // Drains the pipe, because a full pipe would block the program.
        std::thread::spawn(move || lines.for_each(drop));
        let (url, rest) = address
            .split_once("/?")
            .unwrap_or((address.trim_end_matches('/'), ""));
        Self {
            process,
            url: url.to_owned(),
            token: rest.strip_prefix("token=").map(str::to_owned),
        }
    }

    /// Sends a request and returns status and body. A given body is posted as JSON.
    pub fn request(&self, path: &str, body: Option<&str>) -> (u16, Vec<u8>) {
        let url = format!("{}{path}", self.url);
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(Duration::from_secs(120)))
            .build()
            .into();
        let bearer = format!("Bearer {}", self.token.as_deref().unwrap_or_default());
        let response = match body {
            Some(body) => agent
                .post(&url)
                .header("Authorization", &bearer)
                .header("Content-Type", "application/json")
                .send(body),
            None => agent.get(&url).header("Authorization", &bearer).call(),
        };
        let mut response = response.unwrap_or_else(|e| panic!("{path}: {e}"));
        let data = response
            .body_mut()
            .with_config()
            .limit(256 << 20)
            .read_to_vec()
            .unwrap_or_else(|e| panic!("{path}: {e}"));
        (response.status().as_u16(), data)
    }

    pub fn json(&self, path: &str, body: Option<Value>) -> Value {
        let (status, data) = self.request(path, body.map(|b| b.to_string()).as_deref());
        let value = serde_json::from_slice(&data)
            .unwrap_or_else(|e| panic!("{path}: {e}: {}", String::from_utf8_lossy(&data)));
        assert_eq!(status, 200, "{path}: {value}");
        value
    }

    /// Asserts the status `expected`, and returns the error message.
    pub fn refusal(&self, path: &str, body: Option<&str>, expected: u16) -> String {
        let (status, data) = self.request(path, body);
        let value: Value = serde_json::from_slice(&data)
            .unwrap_or_else(|e| panic!("{path}: {e}: {}", String::from_utf8_lossy(&data)));
        assert_eq!(status, expected, "{path} {body:?}: {value}");
        value["error"]
            .as_str()
            .unwrap_or_else(|| panic!("{path}: {value}"))
            .to_owned()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
