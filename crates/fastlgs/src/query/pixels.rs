//! Pixels of a view that show one object, as given by clicks or options.

use fastlgs_core::Camera;
use serde::{Deserialize, Serialize};

/// Pixels of a view that show one object, written as `120,45` or `120,45+160,70`. More pixels show
/// the extent of the object.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "OneOrMore")]
pub struct Pixels(Vec<(u32, u32)>);

/// Largest number of pixels in a query.
const MAX_QUERY_PIXELS: usize = 64;

#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "a pixel [x, y], or a list of such pixels of one object"
)]
enum OneOrMore {
    One((u32, u32)),
    More(Vec<(u32, u32)>),
}

impl TryFrom<OneOrMore> for Pixels {
    type Error = String;

    fn try_from(pixels: OneOrMore) -> Result<Self, String> {
        Self::new(match pixels {
            OneOrMore::One(pixel) => vec![pixel],
            OneOrMore::More(pixels) => pixels,
        })
    }
}

impl Pixels {
    /// Creates a list of pixels, without duplicates.
    ///
    /// # Errors
    /// No pixel, or more than 64.
    pub fn new(pixels: Vec<(u32, u32)>) -> Result<Self, String> {
        let mut own: Vec<(u32, u32)> = Vec::new();
        for pixel in pixels {
            if !own.contains(&pixel) {
                own.push(pixel);
            }
            if own.len() > MAX_QUERY_PIXELS {
                return Err(format!(
                    "a query can have at most {MAX_QUERY_PIXELS} pixels"
                ));
            }
        }
        if own.is_empty() {
            Err("no pixel is given".to_owned())
        } else {
            Ok(Self(own))
        }
    }

    /// Returns x and y of each pixel.
    pub fn all(&self) -> &[(u32, u32)] {
        &self.0
    }

    /// Returns the first pixel outside of a view; `None` if all are inside.
    pub fn outside(&self, camera: &Camera) -> Option<(u32, u32)> {
        self.0
            .iter()
            .copied()
            .find(|(x, y)| *x >= camera.width || *y >= camera.height)
    }
}

impl std::str::FromStr for Pixels {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let pixel = |text: &str| {
            text.split_once(',')
                .and_then(|(x, y)| Some((x.trim().parse().ok()?, y.trim().parse().ok()?)))
        };
        let pixels = text.split('+').map(pixel).collect::<Option<_>>();
        pixels.ok_or_else(|| format!("'{text}' is not a pixel such as 120,45 or a list of pixels of one object such as 120,45+160,70")).and_then(Self::new)
    }
}

impl std::fmt::Display for Pixels {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let pixels: Vec<String> = self.0.iter().map(|(x, y)| format!("{x},{y}")).collect();
        f.write_str(&pixels.join("+"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_parsed_and_formatted() {
        let read = |text: &str| text.parse::<Pixels>();
        assert_eq!(read("120,45"), Ok(Pixels(vec![(120, 45)])));
        assert_eq!(
            read("120,45 + 7, 8+120,45")
                .expect("two pixels")
                .to_string(),
            "120,45+7,8",
            "each once"
        );
        let row = |count: u32| Pixels::new((0..count).map(|x| (x, 0)).collect());
        assert!(row(64).is_ok() && row(65).is_err_and(|e| e.contains("64")));
        let wrong = |json: &str| {
            serde_json::from_str::<Pixels>(json)
                .expect_err(json)
                .to_string()
        };
        assert!(
            wrong("[]").contains("no pixel") && wrong("[[1]]").contains("[x, y]"),
            "{} {}",
            wrong("[]"),
            wrong("[[1]]")
        );
        for wrong in ["", "120", "1,2,3", "-1,2", "1,2+", "1,2;3,4"] {
            assert!(
                read(wrong).expect_err(wrong).contains("120,45+160,70"),
                "{wrong}"
            );
        }
        let json = |text: &str| serde_json::from_str::<Pixels>(text).expect(text).0;
        assert_eq!(
            (json("[1, 2]"), json("[[1, 2], [3, 4]]")),
            (vec![(1, 2)], vec![(1, 2), (3, 4)])
        );
    }
}
