//! Normalises texts, so that different spellings of the same words are equal.

use unicode_normalization::UnicodeNormalization;

/// Articles that are removed from the beginning of a text.
const ARTICLES: [&str; 3] = ["a", "an", "the"];

/// Returns whether a character is invisible: soft hyphen, zero-width character, direction mark or
/// byte order mark.
fn is_invisible(c: char) -> bool {
    matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{2064}' | '\u{feff}')
}

/// Returns whether a character separates words: white space, control character, quote, bracket,
/// hyphen, dash or underscore.
fn is_separator(c: char) -> bool {
    c.is_whitespace()
        || c.is_control()
        || "\"`\u{b4}\u{ab}\u{bb}()[]{}<>-_\u{2010}\u{2011}\u{2012}\u{2013}\u{2014}\u{2015}\u{2212}"
            .contains(c)
        || ('\u{2018}'..='\u{201f}').contains(&c)
}

/// Normalises a text: composes letters (NFC), and separates words by one space. Quotes, brackets,
/// hyphens, invisible characters, leading articles, and punctuation at both ends are removed. The
/// result is empty if nothing remains.
pub fn normalised(text: &str) -> String {
    let composed: String = text.nfc().filter(|c| !is_invisible(*c)).collect();
    let characters: Vec<char> = composed.chars().collect();
    let letter = |at: Option<usize>| {
        at.and_then(|k| characters.get(k))
            .is_some_and(|c| c.is_alphanumeric())
    };
    let plain = |(k, c): (usize, &char)| match c {
        // Between letters or digits it is an apostrophe.
        '\'' | '\u{2019}' if letter(k.checked_sub(1)) && letter(Some(k + 1)) => '\'',
        '\'' => ' ',
        c if is_separator(*c) => ' ',
        c => *c,
    };
    let spaced: String = characters.iter().enumerate().map(plain).collect();
    let mut words: Vec<&str> = spaced.split_whitespace().collect();
    if let Some(first) = words.first_mut() {
        *first = first.trim_start_matches(|c: char| ".,;:!?\u{bf}\u{a1}".contains(c));
    }
    if let Some(last) = words.last_mut() {
        *last = last.trim_end_matches(|c: char| ".,;:!?".contains(c));
    }
    words.retain(|word| !word.is_empty());
    while words.len() > 1
        && ARTICLES
            .iter()
            .any(|article| words[0].eq_ignore_ascii_case(article))
    {
        words.remove(0);
    }
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spellings_of_the_same_words_are_normalised_to_one_text() {
        for text in [
            "red bottle",
            "a red bottle",
            "The red bottle.",
            "an  red\tbottle",
            "\"red bottle\"",
            "\u{201c}red bottle\u{201d}",
            "'red bottle'",
            "(red bottle)",
            "[red] bottle",
            "\u{feff}red bottle",
            "red\u{200b} bottle",
            "red-bottle",
            "red_bottle",
            "red \u{2014} bottle?",
            "the a red bottle",
        ] {
            assert_eq!(normalised(text), "red bottle", "{text:?}");
        }
        assert_eq!(normalised("cafe\u{301}"), normalised("caf\u{e9}"));
        assert_eq!(normalised("the child\u{2019}s toy"), "child's toy");
        assert_eq!(
            ["a", "The", "A4 sheet", "3.5 inch disk"].map(normalised),
            ["a", "The", "A4 sheet", "3.5 inch disk"]
        );
        assert_eq!(["", "  ", "\u{200b}", "\"\"", "?"].map(normalised), [""; 5]);
    }
}
