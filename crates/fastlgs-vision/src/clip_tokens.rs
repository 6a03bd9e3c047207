//! CLIP's byte-pair tokenizer: from the `tokenizer.json` beside a model, else from the merges that OpenAI published.

use crate::{Error, Result, places};
use fastlgs_core::fs;
use flate2::read::GzDecoder;
use serde_json::json;
use std::io::Read;
use std::path::Path;
use tokenizers::Tokenizer;

/// Tokens of a text, start and end included, that the published models take.
pub const CONTEXT: usize = 77;
/// Merges of the published vocabulary; the file holds more.
const MERGES: usize = 49_152 - 256 - 2;
const START: &str = "<|startoftext|>";
const END: &str = "<|endoftext|>";
/// What is one word to the tokenizer: special tokens, English clitics, letters, single digits, other signs.
const WORDS: &str = r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+";

/// Turns texts into token ids.
pub struct ClipTokens {
    tokenizer: Tokenizer,
    start: u32,
    end: u32,
}

impl ClipTokens {
    /// The tokenizer that belongs to a model file: `tokenizer.json` in its folder or the one above, else the published
    /// merges that `models install-offline` keeps.
    ///
    /// # Errors
    /// When neither is there or they are damaged.
    pub fn beside(model: &Path) -> Result<Self> {
        let folders = model.ancestors().skip(1).take(2);
        match folders.map(|f| f.join("tokenizer.json")).find(|f| f.is_file()) {
            Some(path) => Self::new(Tokenizer::from_file(&path).map_err(|e| bad(&path, e))?, &path),
            None => Self::published(&places::offline_dir().join(places::CLIP_MERGES)),
        }
    }

    /// The published tokenizer from its gzipped list of merges.
    ///
    /// # Errors
    /// When the file is missing or damaged.
    pub fn published(path: &Path) -> Result<Self> {
        if !path.is_file() {
            return Err(Error::Missing(format!("{}: no tokenizer; run 'fastlgs models install-offline'", path.display())));
        }
        let mut text = String::new();
        GzDecoder::new(fs::read(path)?.as_slice()).read_to_string(&mut text).map_err(|e| bad(path, e))?;
        let merges: Vec<&str> = text.lines().skip(1).take(MERGES).collect();
        if merges.len() < MERGES {
            return Err(bad(path, format!("it has {} merges instead of {MERGES}", merges.len())));
        }
        // Token ids: bytes, bytes that end a word, merged pairs, the two special tokens.
        let bytes = byte_signs();
        let ending = bytes.iter().map(|b| format!("{b}</w>"));
        let words = bytes.iter().map(char::to_string).chain(ending).chain(merges.iter().map(|m| m.replace(' ', "")));
        let vocabulary: serde_json::Map<String, serde_json::Value> =
            words.chain([START, END].map(str::to_owned)).enumerate().map(|(id, word)| (word, json!(id))).collect();
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
                { "type": "Split", "pattern": { "Regex": WORDS }, "behavior": "Removed", "invert": true },
                { "type": "ByteLevel", "add_prefix_space": false, "trim_offsets": true, "use_regex": false },
            ] },
            "model": {
                "type": "BPE", "unk_token": END, "end_of_word_suffix": "</w>", "continuing_subword_prefix": "",
                "fuse_unk": false, "vocab": vocabulary, "merges": merges,
            },
        });
        Self::new(description.to_string().parse().map_err(|e| bad(path, e))?, path)
    }

    fn new(mut tokenizer: Tokenizer, path: &Path) -> Result<Self> {
        tokenizer.with_padding(None);
        tokenizer.with_truncation(None).map_err(|e| bad(path, e))?;
        let id = |token: &str| tokenizer.token_to_id(token).ok_or_else(|| bad(path, format!("it has no token {token}")));
        Ok(Self { start: id(START)?, end: id(END)?, tokenizer })
    }

    /// Token ids of a text between start and end, cut to `context`.
    ///
    /// # Errors
    /// When a text cannot be tokenised.
    pub fn encode(&self, text: &str, context: usize) -> Result<Vec<u32>> {
        let encoded =
            self.tokenizer.encode(text.trim(), false).map_err(|e| Error::Invalid(format!("'{text}' cannot be tokenised: {e}")))?;
        let words = encoded.get_ids().iter().copied().filter(|id| *id != self.start && *id != self.end).take(context.saturating_sub(2));
        Ok([self.start].into_iter().chain(words).chain([self.end]).collect())
    }

    /// Id that ends a text.
    pub fn end(&self) -> u32 {
        self.end
    }
}

fn bad(path: &Path, reason: impl std::fmt::Display) -> Error {
    Error::Invalid(format!("{}: not a CLIP tokenizer ({reason})", path.display()))
}

/// The printable sign that stands for each byte, in the vocabulary's order: printable bytes stand for themselves, the
/// others, which follow, for signs from U+0100 on.
fn byte_signs() -> Vec<char> {
    let printable = |b: &u8| matches!(b, b'!'..=b'~' | 0xa1..=0xac | 0xae..=0xff);
    let themselves = (0..=u8::MAX).filter(printable).map(char::from);
    let others = (0..=u8::MAX).filter(|b| !printable(b)).enumerate().filter_map(|(k, _)| char::from_u32(0x100 + k as u32));
    themselves.chain(others).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens() -> Option<ClipTokens> {
        match ClipTokens::published(&places::offline_dir().join(places::CLIP_MERGES)) {
            Ok(tokens) => Some(tokens),
            Err(e) if std::env::var_os("FASTLGS_REQUIRE_MODELS").is_some() => panic!("{e}"),
            Err(e) => {
                eprintln!("SKIPPED: {e}");
                None
            }
        }
    }

    /// Ids as published in the documentation of CLIP's implementations.
    #[test]
    fn ids_are_the_published_ones() {
        let Some(tokens) = tokens() else { return };
        let words = |text: &str| tokens.encode(text, CONTEXT).unwrap();
        assert_eq!(words("a photo of a cat"), [49406, 320, 1125, 539, 320, 2368, 49407]);
        assert_eq!(words("  A photo of\n a DOG "), [49406, 320, 1125, 539, 320, 1929, 49407]);
        assert_eq!(words("hello world!"), [49406, 3306, 1002, 256, 49407]);
        assert_eq!(words(""), [49406, 49407]);
    }

    #[test]
    fn long_texts_keep_their_end() {
        let Some(tokens) = tokens() else { return };
        let long = tokens.encode(&"cat ".repeat(200), CONTEXT).unwrap();
        assert_eq!((long.len(), long[0], long[76]), (77, 49406, 49407));
    }

    #[test]
    fn other_files_are_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("merges.gz");
        std::fs::write(&path, b"no gzip").unwrap();
        assert!(ClipTokens::published(&path).err().unwrap().to_string().contains("merges.gz"));
    }
}
