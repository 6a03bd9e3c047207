//! Tokenizers of CLIP (byte-pair encoding) and SigLIP.
//!
//! CLIP's tokenizer is read from the `tokenizer.json` beside a model, or built from the merges that
//! OpenAI published. SigLIP's tokenizer is always read from `tokenizer.json`.

use crate::{Error, Result, model_paths};
use fastlgs_core::fs;
use flate2::read::GzDecoder;
use serde_json::json;
use std::io::Read;
use std::path::{Path, PathBuf};
use tokenizers::Tokenizer;

/// Context length in tokens, including start and end, of the published CLIP and SigLIP models.
const CONTEXT: [usize; 2] = [77, 64];
/// Number of merges in the published vocabulary; the file holds more.
const MERGES: usize = 49_152 - 256 - 2;
const START: &str = "<|startoftext|>";
const END: &str = "<|endoftext|>";
/// Pattern of one word: special tokens, English clitics, letters, single digits, other characters.
const WORD_PATTERN: &str =
    r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+";

/// Converts texts to token ids.
pub struct Tokens {
    tokenizer: Tokenizer,
    kind: Kind,
}

/// Tokens that are added to the words of a text.
enum Kind {
    /// Start and end token of CLIP.
    Clip { start: u32, end: u32 },
    /// The rules of `tokenizer.json` add tokens; `padding` fills the rest of the context.
    Siglip { padding: u32 },
}

impl Tokens {
    /// Loads the CLIP tokenizer of a model file: `tokenizer.json` in its folder or the one above,
    /// else the published merges of `models install-offline`.
    ///
    /// # Errors
    /// Both files are missing, or the one that is used is damaged.
    pub fn load_clip(model: &Path) -> Result<Self> {
        match tokenizer_path(model) {
            Some(path) => Self::of_clip(
                Tokenizer::from_file(&path).map_err(|e| damaged(&path, e))?,
                &path,
            ),
            None => Self::published(&model_paths::offline_dir().join(model_paths::CLIP_MERGES)),
        }
    }

    /// Loads the SigLIP tokenizer beside a model file.
    ///
    /// The padding token is given by `tokenizer.json` or by `tokenizer_config.json` beside it.
    /// Otherwise it is the last token of an encoded empty text, as in the published models.
    ///
    /// # Errors
    /// The file is missing or damaged.
    pub fn load_siglip(model: &Path) -> Result<Self> {
        let missing = || {
            Error::Missing(format!(
                "{}: SigLIP needs a tokenizer.json in the folder of the model or the one above",
                model.display()
            ))
        };
        let path = tokenizer_path(model).ok_or_else(missing)?;
        let mut tokenizer = Tokenizer::from_file(&path).map_err(|e| damaged(&path, e))?;
        let configuration = path.with_file_name("tokenizer_config.json");
        let configuration: serde_json::Value = if configuration.is_file() {
            fs::read_json(&configuration)?
        } else {
            json!(null)
        };
        let token = &configuration["pad_token"];
        let named = || {
            token
                .as_str()
                .or_else(|| token["content"].as_str())
                .and_then(|token| tokenizer.token_to_id(token))
        };
        let configured = tokenizer
            .get_padding()
            .map(|padding| padding.pad_id)
            .or_else(named);
        disable_padding(&mut tokenizer, &path)?;
        let ended = || Some(*tokenizer.encode("", true).ok()?.get_ids().last()?);
        let padding = configured
            .or_else(ended)
            .ok_or_else(|| damaged(&path, "it has no padding token and no end token"))?;
        Ok(Self {
            kind: Kind::Siglip { padding },
            tokenizer,
        })
    }

    /// Builds the published CLIP tokenizer from its gzipped list of merges.
    ///
    /// # Errors
    /// The file is missing or damaged.
    pub fn published(path: &Path) -> Result<Self> {
        if !path.is_file() {
            return Err(Error::Missing(format!(
                "{}: the tokenizer is missing; run 'fastlgs models install-offline'",
                path.display()
            )));
        }
        let mut text = String::new();
        GzDecoder::new(fs::read(path)?.as_slice())
            .read_to_string(&mut text)
            .map_err(|e| damaged(path, e))?;
        let merges: Vec<&str> = text.lines().skip(1).take(MERGES).collect();
        if merges.len() < MERGES {
            return Err(damaged(
                path,
                format!("it has {} merges instead of {MERGES}", merges.len()),
            ));
        }
        // Order of token ids: bytes, bytes at the end of a word, merged pairs, the two special
        // tokens.
        let bytes = byte_signs();
        let ending = bytes.iter().map(|b| format!("{b}</w>"));
        let words = bytes
            .iter()
            .map(char::to_string)
            .chain(ending)
            .chain(merges.iter().map(|m| m.replace(' ', "")));
        let vocabulary: serde_json::Map<String, serde_json::Value> = words
            .chain([START, END].map(str::to_owned))
            .enumerate()
            .map(|(id, word)| (word, json!(id)))
            .collect();
        let special = |id: usize, content: &str| json!({ "id": id, "content": content, "special": true, "single_word": false, "lstrip": false, "rstrip": false, "normalized": false });
        let last = vocabulary.len() - 1;
        let description = json!({
            "version": "1.0",
            "added_tokens": [special(last - 1, START), special(last, END)],
            "normalizer": { "type": "Sequence", "normalizers": [
                { "type": "NFC" },
                { "type": "Replace", "pattern": { "Regex": r"\s+" }, "content": " " },
                { "type": "Lowercase" },
            ] },
            "pre_tokenizer": { "type": "Sequence", "pretokenizers": [
                { "type": "Split", "pattern": { "Regex": WORD_PATTERN }, "behavior": "Removed", "invert": true },
                { "type": "ByteLevel", "add_prefix_space": false, "trim_offsets": true, "use_regex": false },
            ] },
            "model": {
                "type": "BPE", "unk_token": END, "end_of_word_suffix": "</w>", "continuing_subword_prefix": "",
                "fuse_unk": false, "vocab": vocabulary, "merges": merges,
            },
        });
        Self::of_clip(
            description
                .to_string()
                .parse()
                .map_err(|e| damaged(path, e))?,
            path,
        )
    }

    fn of_clip(mut tokenizer: Tokenizer, path: &Path) -> Result<Self> {
        disable_padding(&mut tokenizer, path)?;
        let id = |token: &str| {
            tokenizer
                .token_to_id(token)
                .ok_or_else(|| damaged(path, format!("it has no token {token}")))
        };
        Ok(Self {
            kind: Kind::Clip {
                start: id(START)?,
                end: id(END)?,
            },
            tokenizer,
        })
    }

    /// Returns the token ids of a text with the added tokens, cut to `context`. The last token is
    /// kept.
    ///
    /// # Errors
    /// The text cannot be tokenised.
    pub fn encode(&self, text: &str, context: usize) -> Result<Vec<u32>> {
        let encoded = |special| {
            self.tokenizer
                .encode(text.trim(), special)
                .map_err(|e| Error::Invalid(format!("'{text}' cannot be tokenised: {e}")))
        };
        Ok(match self.kind {
            Kind::Clip { start, end } => {
                let encoded = encoded(false)?;
                let words = encoded
                    .get_ids()
                    .iter()
                    .copied()
                    .filter(|id| *id != start && *id != end)
                    .take(context.saturating_sub(2));
                [start].into_iter().chain(words).chain([end]).collect()
            }
            Kind::Siglip { .. } => {
                let mut ids = encoded(true)?.get_ids().to_vec();
                if ids.len() > context {
                    ids.drain(context.saturating_sub(1)..ids.len() - 1);
                }
                ids
            }
        })
    }

    /// Returns the id of the padding token. `masked` is whether the model takes an attention mask.
    ///
    /// CLIP models of OpenAI are padded with zeros. Those with an attention mask are padded with
    /// the end token, as their tokenizers do.
    pub fn padding(&self, masked: bool) -> u32 {
        match self.kind {
            Kind::Clip { end, .. } => u32::from(masked) * end,
            Kind::Siglip { padding } => padding,
        }
    }

    /// Returns the context length of the published models, in tokens.
    pub fn context(&self) -> usize {
        CONTEXT[usize::from(matches!(self.kind, Kind::Siglip { .. }))]
    }
}

/// Returns the path of `tokenizer.json` in the folder of a model or the one above.
fn tokenizer_path(model: &Path) -> Option<PathBuf> {
    model
        .ancestors()
        .skip(1)
        .take(2)
        .map(|folder| folder.join("tokenizer.json"))
        .find(|file| file.is_file())
}

/// Turns off padding and truncation of the tokenizer; both are done here.
fn disable_padding(tokenizer: &mut Tokenizer, path: &Path) -> Result<()> {
    tokenizer.with_padding(None);
    tokenizer
        .with_truncation(None)
        .map_err(|e| damaged(path, e))?;
    Ok(())
}

fn damaged(path: &Path, reason: impl std::fmt::Display) -> Error {
    Error::Invalid(format!(
        "{}: not a tokenizer of CLIP or SigLIP ({reason})",
        path.display()
    ))
}

/// Returns the printable character that represents each byte, in the order of the vocabulary.
/// Printable bytes represent themselves. The others follow, as characters from U+0100 on.
fn byte_signs() -> Vec<char> {
    let printable = |b: &u8| matches!(b, b'!'..=b'~' | 0xa1..=0xac | 0xae..=0xff);
    let themselves = (0..=u8::MAX).filter(printable).map(char::from);
    let others = (0..=u8::MAX)
        .filter(|b| !printable(b))
        .enumerate()
        .filter_map(|(k, _)| char::from_u32(0x100 + k as u32));
    themselves.chain(others).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens() -> Option<Tokens> {
        match Tokens::published(&model_paths::offline_dir().join(model_paths::CLIP_MERGES)) {
            Ok(tokens) => Some(tokens),
            Err(e) if std::env::var_os("FASTLGS_REQUIRE_MODELS").is_some() => panic!("{e}"),
            Err(e) => {
                crate::skip::skip(format_args!("{e}"));
                None
            }
        }
    }

    /// Ids as in the documentation of CLIP implementations.
    #[test]
    fn ids_are_the_published_ones() {
        let Some(tokens) = tokens() else { return };
        let words = |text: &str| tokens.encode(text, 77).unwrap();
        assert_eq!(
            words("a photo of a cat"),
            [49406, 320, 1125, 539, 320, 2368, 49407]
        );
        assert_eq!(
            words("  A photo of\n a DOG "),
            [49406, 320, 1125, 539, 320, 1929, 49407]
        );
        assert_eq!(words("hello world!"), [49406, 3306, 1002, 256, 49407]);
        assert_eq!(words(""), [49406, 49407]);
    }

    #[test]
    fn long_texts_keep_their_end() {
        let Some(tokens) = tokens() else { return };
        let long = tokens
            .encode(&"cat ".repeat(200), tokens.context())
            .unwrap();
        assert_eq!((long.len(), long[0], long[76]), (77, 49406, 49407));
    }

    #[test]
    fn siglip_tokens_and_padding_come_from_its_files() {
        let dir = tempfile::tempdir().unwrap();
        let model = dir.path().join("onnx").join("text_model.onnx");
        assert!(
            Tokens::load_siglip(&model)
                .err()
                .unwrap()
                .to_string()
                .contains("tokenizer.json")
        );
        let mut description = json!({
            "version": "1.0",
            "added_tokens": [],
            "normalizer": { "type": "Lowercase" },
            "pre_tokenizer": { "type": "Whitespace" },
            "post_processor": {
                "type": "TemplateProcessing",
                "single": [{ "Sequence": { "id": "A", "type_id": 0 } }, { "SpecialToken": { "id": "</s>", "type_id": 0 } }],
                "pair": [{ "Sequence": { "id": "A", "type_id": 0 } }, { "Sequence": { "id": "B", "type_id": 1 } }],
                "special_tokens": { "</s>": { "id": "</s>", "ids": [1], "tokens": ["</s>"] } },
            },
            "model": { "type": "WordLevel", "unk_token": "<unk>", "vocab": { "<pad>": 0, "</s>": 1, "red": 2, "fox": 3, "<unk>": 4 } },
        });
        let write = |description: &serde_json::Value| {
            std::fs::write(dir.path().join("tokenizer.json"), description.to_string()).unwrap()
        };
        write(&description);
        // The vocabulary has a token "<pad>" that is not the padding token.
        let tokens = Tokens::load_siglip(&model).unwrap();
        assert_eq!(
            (
                tokens.encode(" Red fox", 64).unwrap(),
                tokens.padding(false),
                tokens.context()
            ),
            (vec![2, 3, 1], 1, 64)
        );
        assert_eq!(
            tokens.encode("red fox red fox", 3).unwrap(),
            [2, 3, 1],
            "a long text keeps its end"
        );
        std::fs::write(
            dir.path().join("tokenizer_config.json"),
            r#"{"pad_token": {"content": "fox"}}"#,
        )
        .unwrap();
        assert_eq!(Tokens::load_siglip(&model).unwrap().padding(false), 3);
        description["padding"] = json!({
            "strategy": { "Fixed": 64 }, "direction": "Right", "pad_to_multiple_of": null, "pad_id": 7, "pad_type_id": 0, "pad_token": "<x>",
        });
        write(&description);
        let tokens = Tokens::load_siglip(&model).unwrap();
        assert_eq!(
            (tokens.encode("fox", 64).unwrap(), tokens.padding(false)),
            (vec![3, 1], 7),
            "padding is added by the caller, not by the tokenizer"
        );
    }

    #[test]
    fn other_files_are_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("merges.gz");
        std::fs::write(&path, b"no gzip").unwrap();
        assert!(
            Tokens::published(&path)
                .err()
                .unwrap()
                .to_string()
                .contains("merges.gz")
        );
    }
}
