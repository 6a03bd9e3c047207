//! Drives headless Chromium through chromedriver, with the WebDriver requests that the viewer's
//! tests need.
#![allow(dead_code)]

use base64::Engine as _;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Limit of every wait. Even software rendering on a busy machine is faster.
const TIMEOUT: Duration = Duration::from_secs(180);

/// A browser with one page. Dropping this value ends it.
pub struct Browser {
    driver: Child,
    session: String,
    agent: ureq::Agent,
}

/// Returns whether Chromium and its driver are installed.
pub fn installed() -> bool {
    let runs = |program: &str| {
        Command::new(program)
            .arg("--version")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .is_ok()
    };
    runs("chromedriver") && runs("chromium")
}

impl Browser {
    /// Opens a window of this size in pixels, with additional flags.
    pub fn open(width: u32, height: u32, flags: &[&str]) -> Self {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("chromedriver");
        let lines = BufReader::new(driver.stdout.take().expect("piped"))
            .lines()
            .map_while(Result::ok);
        let port = lines
            .filter_map(|l| {
                l.split("on port ")
                    .nth(1)
                    .map(|p| p.trim_end_matches('.').to_owned())
            })
            .find(|p| p.parse::<u16>().is_ok_and(|p| p > 0));
        let base = format!(
            "http://127.0.0.1:{}/session",
            port.expect("chromedriver prints its port")
        );
        let agent = ureq::Agent::config_builder()
            .timeout_global(Some(2 * TIMEOUT))
            .http_status_as_error(false)
            .build()
            .into();
        let size = format!("--window-size={width},{height}");
        let mut args = vec![
            "--headless=new",
            "--no-sandbox",
            "--disable-dev-shm-usage",
            "--hide-scrollbars",
            &size,
        ];
        args.extend(flags);
        let options = json!({ "args": args });
        let timeouts = json!({ "script": TIMEOUT.as_millis() as u64 });
        let logs = json!({ "browser": "ALL" });
        let always = json!({ "browserName": "chrome", "timeouts": timeouts, "goog:chromeOptions": options, "goog:loggingPrefs": logs });
        let mut browser = Self {
            driver,
            session: base,
            agent,
        };
        let made = browser.post("", &json!({ "capabilities": { "alwaysMatch": always } }));
        browser.session = format!(
            "{}/{}",
            browser.session,
            made["sessionId"].as_str().expect("a session")
        );
        browser
    }

    fn post(&self, path: &str, body: &Value) -> Value {
        let url = format!("{}{path}", self.session);
        let mut response = self
            .agent
            .post(&url)
            .header("Content-Type", "application/json")
            .send(body.to_string())
            .expect("chromedriver answers");
        let text = response
            .body_mut()
            .with_config()
            .limit(64 << 20)
            .read_to_string()
            .expect("an answer");
        let value: Value = serde_json::from_str(&text).expect("JSON");
        assert!(response.status().is_success(), "{path}: {value}");
        value["value"].clone()
    }

    pub fn go(&self, url: &str) {
        self.post("/url", &json!({ "url": url }));
    }

    /// Runs the body of an async function and returns its result. A thrown error fails the test.
    pub fn run(&self, body: &str) -> Value {
        let script = format!(
            "const done = arguments[0]; (async () => {{ {body} }})().then((v) => done({{ v }}), (e) => done({{ e: String(e) }}));"
        );
        let result = self.post("/execute/async", &json!({ "script": script, "args": [] }));
        assert!(result["e"].is_null(), "{body}: {}", result["e"]);
        result["v"].clone()
    }

    /// Waits until an expression is true.
    pub fn wait_for(&self, expression: &str) {
        let began = Instant::now();
        while self.run(&format!("return Boolean({expression});")) != true {
            let problem = self.run("return document.getElementById('problem')?.textContent ?? '';");
            assert!(
                began.elapsed() < TIMEOUT,
                "'{expression}' did not become true; message on the page: {problem}"
            );
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    /// Types into the focused element.
    pub fn keys(&self, keys: &str) {
        let actions: Vec<Value> = keys
            .chars()
            .flat_map(|k| {
                [
                    json!({ "type": "keyDown", "value": k }),
                    json!({ "type": "keyUp", "value": k }),
                ]
            })
            .collect();
        self.post(
            "/actions",
            &json!({ "actions": [{ "type": "key", "id": "keyboard", "actions": actions }] }),
        );
    }

    /// Runs `work` while a key is held.
    pub fn holding<T>(&self, key: &str, work: impl FnOnce() -> T) -> T {
        let send_key = |kind: &str| {
            let action = json!({ "type": kind, "value": key });
            self.post(
                "/actions",
                &json!({ "actions": [{ "type": "key", "id": "keyboard", "actions": [action] }] }),
            );
        };
        send_key("keyDown");
        let done = work();
        send_key("keyUp");
        done
    }

    /// Presses the mouse button at one position of the page and releases it at another.
    pub fn drag(&self, from: [i32; 2], to: [i32; 2]) {
        let to_place =
            |p: [i32; 2]| json!({ "type": "pointerMove", "duration": 50, "x": p[0], "y": p[1] });
        let actions = [
            to_place(from),
            json!({ "type": "pointerDown", "button": 0 }),
            to_place(to),
            json!({ "type": "pointerUp", "button": 0 }),
        ];
        self.post(
            "/actions",
            &json!({ "actions": [{ "type": "pointer", "id": "mouse", "actions": actions }] }),
        );
    }

    /// Places two fingers at the distance `from` left and right of `at`, and moves them to the
    /// distance `to`. All values are in pixels.
    pub fn pinch(&self, at: [i32; 2], from: i32, to: i32) {
        let finger = |id: &str, side: i32| {
            let to_place = |far: i32, ms: u32| json!({ "type": "pointerMove", "duration": ms, "x": at[0] + side * far, "y": at[1] });
            let actions = [
                to_place(from, 0),
                json!({ "type": "pointerDown", "button": 0 }),
                to_place(to, 100),
                json!({ "type": "pointerUp", "button": 0 }),
            ];
            json!({ "type": "pointer", "id": id, "parameters": { "pointerType": "touch" }, "actions": actions })
        };
        self.post(
            "/actions",
            &json!({ "actions": [finger("left", -1), finger("right", 1)] }),
        );
    }

    /// Returns the bytes of a data URL.
    pub fn decode(url: &Value) -> Vec<u8> {
        let url = url.as_str().expect("a data URL");
        base64::engine::general_purpose::STANDARD
            .decode(url.split(',').nth(1).expect("a data URL"))
            .expect("base64")
    }

    pub fn screenshot(&self, path: &Path) {
        let mut response = self
            .agent
            .get(&format!("{}/screenshot", self.session))
            .call()
            .expect("a screenshot");
        let body = response
            .body_mut()
            .with_config()
            .limit(64 << 20)
            .read_to_vec()
            .expect("an answer");
        let value: Value = serde_json::from_slice(&body).expect("JSON");
        let data = base64::engine::general_purpose::STANDARD
            .decode(value["value"].as_str().expect("base64"))
            .expect("base64");
        std::fs::write(path, data).expect("the screenshot");
    }

    /// Returns the console errors since the last call.
    pub fn errors(&self) -> Vec<String> {
        let logs = self.post("/se/log", &json!({ "type": "browser" }));
        let logs = logs
            .as_array()
            .expect("a list")
            .iter()
            .filter(|l| l["level"] == "SEVERE");
        logs.map(|l| l["message"].as_str().unwrap_or_default().to_owned())
            .collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.agent.delete(&self.session).call();
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
