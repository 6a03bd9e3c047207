//! `models pull`: downloads named ONNX exports of SAM and CLIP over HTTPS.
//!
//! The host announces length and SHA-256 of large files: a model repository stores them behind Git
//! LFS pointers. `pulled.json` records each downloaded file, and a later download must match this
//! record.

use crate::model_paths::digest;
use crate::{Error, Result};
use fastlgs_core::scene_folder::ModelFile;
use fastlgs_core::{Error as CoreError, fs};
use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;
use ureq::Agent;

/// Default host of the repositories.
pub const HOST: &str = "https://huggingface.co";

/// Purpose of a model pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Image encoder and prompt decoder.
    Sam,
    /// Image and text tower.
    Clip,
}

/// A pair of models that can be pulled.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct ModelPair {
    /// Name by which users select it.
    pub name: &'static str,
    /// Purpose of the pair.
    pub role: Role,
    /// Repository of the exports.
    pub repository: &'static str,
    /// Licence of the weights.
    pub licence: &'static str,
}

/// All model pairs that can be pulled.
pub const MODEL_PAIRS: [ModelPair; 5] = [
    ModelPair {
        name: "slimsam",
        role: Role::Sam,
        repository: "Xenova/slimsam-77-uniform",
        licence: "Apache-2.0",
    },
    ModelPair {
        name: "sam-vit-b",
        role: Role::Sam,
        repository: "Xenova/sam-vit-base",
        licence: "Apache-2.0",
    },
    ModelPair {
        name: "clip-vit-b16",
        role: Role::Clip,
        repository: "Xenova/clip-vit-base-patch16",
        licence: "MIT",
    },
    ModelPair {
        name: "clip-vit-b32",
        role: Role::Clip,
        repository: "Xenova/clip-vit-base-patch32",
        licence: "MIT",
    },
    ModelPair {
        name: "clip-vit-l14",
        role: Role::Clip,
        repository: "Xenova/clip-vit-large-patch14",
        licence: "MIT",
    },
];

impl ModelPair {
    /// Returns the model pair of that name.
    ///
    /// # Errors
    /// An unknown name; the message lists all names.
    pub fn find(name: &str) -> Result<Self> {
        MODEL_PAIRS
            .into_iter()
            .find(|n| n.name == name)
            .ok_or_else(|| {
                let known: Vec<&str> = MODEL_PAIRS.iter().map(|n| n.name).collect();
                Error::Missing(format!(
                    "unknown model '{name}'; the available models are: {}",
                    known.join(", ")
                ))
            })
    }

    /// Returns the files to pull from the repository, the two models first.
    pub fn files(&self) -> &'static [&'static str] {
        match self.role {
            Role::Sam => &[
                "onnx/vision_encoder.onnx",
                "onnx/prompt_encoder_mask_decoder.onnx",
            ],
            Role::Clip => &[
                "onnx/vision_model.onnx",
                "onnx/text_model.onnx",
                "tokenizer.json",
                "preprocessor_config.json",
            ],
        }
    }

    /// Returns the folder that the files are pulled into.
    pub fn folder(&self) -> PathBuf {
        fs::cache_dir().join("models").join(self.name)
    }

    /// Returns the paths of encoder and decoder, or of image and text tower.
    ///
    /// # Errors
    /// A file that was not pulled; the message says how to pull it.
    pub fn pair(&self) -> Result<[PathBuf; 2]> {
        let pair = [0, 1].map(|k| self.folder().join(self.files()[k]));
        match pair.iter().find(|p| !p.is_file()) {
            None => Ok(pair),
            Some(missing) => {
                let (name, missing) = (self.name, missing.display());
                Err(Error::Missing(format!(
                    "{missing}: file not found; run 'fastlgs models pull {name}', or give the paths of your own files"
                )))
            }
        }
    }
}

/// Expected length and SHA-256 of a file; `None` if unknown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Expected {
    bytes: Option<u64>,
    sha256: Option<String>,
}

/// Number of attempts per file. Each continues the previous one.
const TRIES: usize = 4;
/// Largest size of a Git LFS pointer, in bytes.
const POINTER: u64 = 1024;

/// HTTP client, repository URL and target folder of a download.
struct Puller<'a> {
    agent: Agent,
    base: String,
    folder: &'a Path,
}

/// Downloads all files of a model that are missing or damaged, and returns the records of all its
/// files.
/// `progress` receives the file, the bytes done and the total bytes. The proxy comes from the
/// environment (`HTTPS_PROXY`, `ALL_PROXY`).
///
/// # Errors
/// The host cannot be reached, breaks off repeatedly, or sends an unexpected file. Existing files
/// are kept.
pub fn pull(
    model: &ModelPair,
    host: &str,
    folder: &Path,
    mut progress: impl FnMut(&str, u64, Option<u64>),
) -> Result<BTreeMap<String, ModelFile>> {
    let config = Agent::config_builder()
        .timeout_connect(Some(Duration::from_secs(20)))
        .timeout_recv_response(Some(Duration::from_secs(60)));
    let puller = Puller {
        agent: config.build().into(),
        base: format!("{}/{}", host.trim_end_matches('/'), model.repository),
        folder,
    };
    let record = folder.join("pulled.json");
    let mut pulled: BTreeMap<String, ModelFile> = if record.is_file() {
        fs::read_json(&record)?
    } else {
        BTreeMap::new()
    };
    for &file in model.files() {
        let path = folder.join(file);
        if let Some(known) = pulled.get(file).filter(|_| path.is_file()) {
            if digest(&path)? == (known.bytes, known.sha256.clone()) {
                continue;
            }
            tracing::warn!(
                "{}: the file has changed since it was pulled; pulling it again",
                path.display()
            );
        }
        let mut expected = puller.pointer(file)?;
        // The record of an earlier download takes precedence over what a mirror announces.
        if let Some(known) = pulled.get(file) {
            expected = Expected {
                bytes: Some(known.bytes),
                sha256: Some(known.sha256.clone()),
            };
        }
        let partial = puller.fetch(file, &expected, &mut progress)?;
        let (bytes, sha256) = digest(&partial)?;
        std::fs::rename(&partial, &path).map_err(CoreError::io(&path))?;
        pulled.insert(
            file.to_owned(),
            ModelFile {
                path,
                bytes,
                sha256,
            },
        );
        fs::write_json(&record, &pulled)?;
    }
    Ok(pulled)
}

impl Puller<'_> {
    /// Fetches the Git LFS pointer of a file. Returns empty expectations if there is none.
    fn pointer(&self, file: &str) -> Result<Expected> {
        let url = format!("{}/raw/main/{file}", self.base);
        let answer = self.agent.get(&url).call();
        let mut text = String::new();
        match answer {
            Ok(answer) => drop(
                answer
                    .into_body()
                    .into_reader()
                    .take(POINTER)
                    .read_to_string(&mut text),
            ),
            Err(ureq::Error::StatusCode(_)) => return Ok(Expected::default()),
            Err(e) => return Err(unreachable(&url, &e)),
        }
        if !text.starts_with("version https://git-lfs") {
            return Ok(Expected::default());
        }
        let field = |name: &str| {
            text.lines()
                .find_map(|l| l.strip_prefix(name))
                .map(|v| v.trim().to_owned())
        };
        Ok(Expected {
            bytes: field("size ").and_then(|v| v.parse().ok()),
            sha256: field("oid sha256:"),
        })
    }

    /// Downloads a file to `FILE.partial`, checks it, and returns that path.
    fn fetch(
        &self,
        file: &str,
        expected: &Expected,
        progress: &mut impl FnMut(&str, u64, Option<u64>),
    ) -> Result<PathBuf> {
        let partial = self.folder.join(format!("{file}.partial"));
        let parent = partial.parent().unwrap_or(self.folder);
        std::fs::create_dir_all(parent).map_err(CoreError::io(parent))?;
        let url = format!("{}/resolve/main/{file}", self.base);
        let mut reason = String::new();
        for _ in 0..TRIES {
            match self.continue_file(&url, &partial, |done, total| {
                progress(file, done, expected.bytes.or(total))
            })? {
                Transfer::Whole => {
                    if let Err(why) = check(file, &partial, expected) {
                        let _ = std::fs::remove_file(&partial);
                        return Err(Error::Missing(format!(
                            "{url}: {why}; the file was not installed; set base_url to another mirror, or download the file manually"
                        )));
                    }
                    return Ok(partial);
                }
                Transfer::BrokeOff(why) => reason = why,
            }
        }
        Err(Error::Missing(format!(
            "{url}: the transfer broke off {TRIES} times ({reason}); run the command again to resume it"
        )))
    }

    /// Resumes a transfer after the bytes that are already in `partial`.
    fn continue_file(
        &self,
        url: &str,
        partial: &Path,
        mut say: impl FnMut(u64, Option<u64>),
    ) -> Result<Transfer> {
        let have = std::fs::metadata(partial).map_or(0, |m| m.len());
        let mut request = self.agent.get(url);
        if have > 0 {
            request = request.header("Range", format!("bytes={have}-"));
        }
        let answer = match request.call() {
            Ok(answer) => answer,
            // The host has no bytes beyond those in the file. The file is complete, or too long and
            // fails its check.
            Err(ureq::Error::StatusCode(416)) => return Ok(Transfer::Whole),
            Err(ureq::Error::StatusCode(code)) => {
                return Err(Error::Missing(format!(
                    "{url}: the host answered with status {code}; check that it is a mirror of {HOST}"
                )));
            }
            Err(e) if have > 0 => return Ok(Transfer::BrokeOff(e.to_string())),
            Err(e) => return Err(unreachable(url, &e)),
        };
        let resumes = answer.status() == 206;
        let mut done = if resumes { have } else { 0 };
        let length = answer
            .headers()
            .get("content-length")
            .and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
        let total = length.map(|l| l + done);
        let file = OpenOptions::new()
            .create(true)
            .write(true)
            .append(resumes)
            .truncate(!resumes)
            .open(partial);
        let mut file = file.map_err(CoreError::io(partial))?;
        let mut reader = answer.into_body().into_reader();
        let mut buffer = vec![0; 1 << 16];
        loop {
            match reader.read(&mut buffer) {
                Ok(0) => break,
                Ok(n) => file
                    .write_all(&buffer[..n])
                    .map_err(CoreError::io(partial))?,
                Err(e) => return Ok(Transfer::BrokeOff(e.to_string())),
            }
            done = file.metadata().map_err(CoreError::io(partial))?.len();
            say(done, total);
        }
        Ok(if total.is_none_or(|t| t == done) {
            Transfer::Whole
        } else {
            Transfer::BrokeOff("the host sent fewer bytes than announced".to_owned())
        })
    }
}

/// How a transfer ended.
enum Transfer {
    Whole,
    BrokeOff(String),
}

fn unreachable(url: &str, e: &ureq::Error) -> Error {
    Error::Missing(format!(
        "{url}: cannot be reached ({e}); check the connection or HTTPS_PROXY, or set base_url to a mirror"
    ))
}

/// Checks length, SHA-256 and first bytes of a file. The error is the reason for a message.
fn check(file: &str, path: &Path, expected: &Expected) -> Result<(), String> {
    let (bytes, sha256) = digest(path).map_err(|e| e.to_string())?;
    if expected.bytes.is_some_and(|b| b != bytes) {
        return Err(format!(
            "it is {bytes} bytes long instead of {}",
            expected.bytes.unwrap_or(0)
        ));
    }
    if expected.sha256.as_ref().is_some_and(|s| *s != sha256) {
        return Err(format!(
            "its SHA-256 is {sha256}, which is not the expected one"
        ));
    }
    let mut start = [0; 2];
    let read = std::fs::File::open(path)
        .and_then(|mut f| f.read(&mut start))
        .unwrap_or(0);
    // An ONNX file begins with its version (protobuf field 1, an integer); JSON with a bracket.
    let plausible = if file.ends_with(".onnx") {
        read == 2 && start[0] == 0x08 && start[1] < 0x40
    } else {
        matches!(start[0], b'{' | b'[')
    };
    if plausible {
        Ok(())
    } else {
        Err("it is neither an ONNX nor a JSON file; the host may have sent a web page".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sha2::{Digest, Sha256};
    use std::io::{BufRead, BufReader};
    use std::net::{TcpListener, TcpStream};
    use std::sync::{Arc, Mutex};

    /// Faults of the local test host.
    #[derive(Clone, Copy, PartialEq)]
    enum Manner {
        Good,
        /// Closes the first transfer of every file halfway.
        BreaksOff,
        /// Always announces more bytes than it sends.
        LiesAboutLength,
        /// Sends an HTML page instead of the file.
        SendsPage,
        /// Sends a changed file of the right length.
        SendsOther,
        /// Has no such repository.
        NotFound,
    }

    fn content(file: &str) -> Vec<u8> {
        if file.ends_with(".onnx") {
            [&[8, 8][..], &vec![7; 300_000], file.as_bytes()].concat()
        } else {
            b"{}".to_vec()
        }
    }

    fn answer(mut stream: TcpStream, manner: Manner, asked: &Mutex<Vec<String>>) {
        let mut lines = BufReader::new(stream.try_clone().unwrap())
            .lines()
            .map_while(|l| l.ok());
        let request = lines.next().unwrap_or_default();
        let headers: Vec<String> = lines.take_while(|l| !l.is_empty()).collect();
        let path = request.split(' ').nth(1).unwrap_or_default().to_owned();
        let range = headers.iter().find_map(|h| {
            h.to_lowercase()
                .strip_prefix("range: bytes=")?
                .strip_suffix('-')?
                .parse::<usize>()
                .ok()
        });
        let again = {
            let mut asked = asked.lock().unwrap();
            asked.push(format!("{path} {range:?}"));
            asked
                .iter()
                .filter(|p| p.starts_with(&format!("{path} ")))
                .count()
                > 1
        };
        let file = path.split_once("/main/").map(|p| p.1).unwrap_or_default();
        let mut body = content(file);
        let mut respond = |status: &str, length: usize, body: &[u8]| {
            let _ = write!(
                stream,
                "HTTP/1.1 {status}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
            );
            let _ = stream.write_all(body);
        };
        if manner == Manner::NotFound {
            return respond("404 Not Found", 0, b"");
        }
        if path.contains("/raw/") {
            let hash = Sha256::digest(&body)
                .iter()
                .map(|b| format!("{b:02x}"))
                .collect::<String>();
            let pointer = format!(
                "version https://git-lfs.github.com/spec/v1\noid sha256:{hash}\nsize {}\n",
                body.len()
            );
            return respond("200 OK", pointer.len(), pointer.as_bytes());
        }
        match manner {
            Manner::SendsPage => body = b"<html>Please log in</html>".to_vec(),
            Manner::SendsOther => *body.last_mut().unwrap() ^= 1,
            _ => {}
        }
        let from = range.unwrap_or(0).min(body.len());
        let status = if range.is_some() {
            "206 Partial Content"
        } else {
            "200 OK"
        };
        let rest = &body[from..];
        match manner {
            Manner::BreaksOff if !again => respond(status, rest.len(), &rest[..rest.len() / 2]),
            Manner::LiesAboutLength => respond(status, rest.len() + 10, rest),
            _ => respond(status, rest.len(), rest),
        }
    }

    /// Starts a host on this machine. Returns its address and the log of requests.
    fn host(manner: Manner) -> (String, Arc<Mutex<Vec<String>>>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let asked = Arc::new(Mutex::new(Vec::new()));
        let log = asked.clone();
        std::thread::spawn(move || {
            listener
                .incoming()
                .flatten()
                .for_each(|stream| answer(stream, manner, &log))
        });
        (address, asked)
    }

    fn try_pull(
        manner: Manner,
        folder: &Path,
    ) -> (Result<BTreeMap<String, ModelFile>>, Vec<String>) {
        let (address, asked) = host(manner);
        let result = pull(
            &ModelPair::find("slimsam").unwrap(),
            &address,
            folder,
            |_, _, _| {},
        );
        let asked = asked.lock().unwrap().clone();
        (result, asked)
    }

    #[test]
    fn pulled_files_are_complete_and_not_requested_again() {
        let dir = tempfile::tempdir().unwrap();
        let (pulled, asked) = try_pull(Manner::Good, dir.path());
        assert_eq!((pulled.unwrap().len(), asked.len()), (2, 4));
        let file = "onnx/vision_encoder.onnx";
        assert_eq!(std::fs::read(dir.path().join(file)).unwrap(), content(file));
        let (pulled, asked) = try_pull(Manner::NotFound, dir.path());
        assert_eq!(
            (pulled.unwrap().len(), asked.len()),
            (2, 0),
            "complete files must not be requested again"
        );
        std::fs::write(dir.path().join(file), b"damaged").unwrap();
        try_pull(Manner::Good, dir.path()).0.unwrap();
        assert_eq!(std::fs::read(dir.path().join(file)).unwrap(), content(file));
    }

    #[test]
    fn broken_transfers_are_resumed() {
        let dir = tempfile::tempdir().unwrap();
        let (pulled, asked) = try_pull(Manner::BreaksOff, dir.path());
        assert_eq!(pulled.unwrap().len(), 2);
        assert!(
            asked
                .iter()
                .any(|a| a.contains("/resolve/") && a.contains("Some(15")),
            "the second half must be requested: {asked:?}"
        );
    }

    #[test]
    fn wrong_files_are_not_installed() {
        for (manner, said) in [
            (Manner::LiesAboutLength, "broke off"),
            (Manner::SendsPage, "bytes long"),
            (Manner::SendsOther, "SHA-256"),
            (Manner::NotFound, "404"),
        ] {
            let dir = tempfile::tempdir().unwrap();
            let error = try_pull(manner, dir.path()).0.unwrap_err().to_string();
            assert!(
                error.contains(said) && error.contains("vision_encoder.onnx"),
                "{error}"
            );
            assert!(!dir.path().join("onnx/vision_encoder.onnx").exists());
        }
        let dir = tempfile::tempdir().unwrap();
        let nowhere = pull(
            &MODEL_PAIRS[0],
            "http://127.0.0.1:1",
            dir.path(),
            |_, _, _| {},
        )
        .unwrap_err()
        .to_string();
        assert!(nowhere.contains("cannot be reached"), "{nowhere}");
        assert!(
            ModelPair::find("sam9")
                .unwrap_err()
                .to_string()
                .contains("slimsam")
        );
    }
}
