//! Figures of rows over their seeds.

use super::rows::Rows;
use super::ways::BASE;
use serde_json::Value;
use std::collections::BTreeSet;

/// A figure over the seeds of a way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mean {
    pub mean: f64,
    pub low: f64,
    pub high: f64,
}

impl Mean {
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.into_iter().collect();
        let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().reduce(pick);
        Some(Self {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            low: fold(f64::min)?,
            high: fold(f64::max)?,
        })
    }

    /// Returns the figure in another unit.
    pub fn times(self, factor: f64) -> Self {
        let Self { mean, low, high } = self;
        let [mean, low, high] = [mean, low, high].map(|v| factor * v);
        Self { mean, low, high }
    }

    /// Formats mean and range; the mean alone if all values are the same.
    pub fn text(self, digits: usize) -> String {
        self.formatted(|v| format!("{v:.digits$}"))
    }

    /// The same with signs.
    pub fn signed(self, digits: usize) -> String {
        self.formatted(|v| signed(v, digits))
    }

    fn formatted(self, format: impl Fn(f64) -> String) -> String {
        let Self { mean, low, high } = self;
        let [mean, low, high] = [mean, low, high].map(format);
        if low == high {
            mean
        } else {
            format!("{mean} ({low} to {high})")
        }
    }
}

/// The rows of a way on a scene, one for each seed.
pub struct Runs<'a> {
    pub rows: Vec<&'a Value>,
    /// The rows whose times count: those of the processor that timed the most rows, if there are any,
    /// else all.
    timed: Vec<&'a Value>,
}

impl<'a> Runs<'a> {
    pub fn of(rows: &'a Rows, scene: &str, way: &str) -> Option<Self> {
        let is_run = |row: &&Value| row["scene"] == scene && row["way"] == way;
        let runs: Vec<&Value> = rows.rows.iter().filter(is_run).collect();
        let main = machines(rows).first().copied();
        let is_main = |row: &&Value| row["machine"].as_str() == main && row["seconds"].is_object();
        let mut timed: Vec<&Value> = runs.iter().copied().filter(is_main).collect();
        if timed.is_empty() {
            timed = runs.clone();
        }
        (!runs.is_empty()).then_some(Self { rows: runs, timed })
    }

    /// Returns the rows with the seeds of other runs.
    pub fn with_seeds_of(mut self, other: &Self) -> Self {
        let is_kept = |row: &&Value| other.rows.iter().any(|o| o["seed"] == row["seed"]);
        self.rows.retain(is_kept);
        self.timed.retain(is_kept);
        self
    }

    pub fn mean(&self, figure: &str) -> Option<Mean> {
        Mean::of(self.rows.iter().filter_map(|row| row[figure].as_f64()))
    }

    /// Seconds of a stage.
    pub fn seconds(&self, stage: &str) -> Option<Mean> {
        let of = |row: &&Value| row["seconds"][stage].as_f64();
        Mean::of(self.timed.iter().filter_map(of))
    }

    /// Seconds from photos to answers.
    pub fn total_seconds(&self) -> Option<Mean> {
        Mean::of(self.timed.iter().filter_map(|row| total_seconds(row)))
    }

    /// Size of all files that a query needs.
    pub fn megabytes(&self) -> Option<Mean> {
        Some(self.mean("scene_bytes")?.times(1e-6))
    }

    /// Milliseconds of the first query of a view.
    pub fn query_milliseconds(&self) -> Option<Mean> {
        Mean::of(self.timed.iter().filter_map(|row| row["query_ms"].as_f64()))
    }

    pub fn text(&self, figure: &str, digits: usize) -> String {
        self.mean(figure)
            .map_or(String::new(), |mean| mean.text(digits))
    }

    /// Formats a count, with its range if the seeds differ.
    pub fn count(&self, figure: &str) -> String {
        self.text(figure, 1).replace(".0", "")
    }

    /// Number of rows with seconds that count.
    pub fn timed(&self) -> usize {
        let has_seconds = |row: &&&Value| row["seconds"].is_object();
        self.timed.iter().filter(has_seconds).count()
    }

    /// A comparison with the rows of other runs that have the same seed.
    fn against(
        &self,
        reference: &Self,
        compare: impl Fn(&Value, &Value) -> Option<f64>,
    ) -> Option<Mean> {
        Mean::of(self.rows.iter().filter_map(|row| {
            let is_same = |other: &&&Value| other["seed"] == row["seed"];
            compare(row, reference.rows.iter().find(is_same)?)
        }))
    }

    /// Change of a figure against other runs with the same seed.
    pub fn change(&self, figure: &str, reference: &Self) -> Option<Mean> {
        self.against(reference, |row, other| {
            Some(row[figure].as_f64()? - other[figure].as_f64()?)
        })
    }

    /// Ratio of a figure to that of other runs with the same seed.
    pub fn ratio(&self, figure: impl Fn(&Value) -> Option<f64>, reference: &Self) -> Option<Mean> {
        self.against(reference, |row, other| Some(figure(row)? / figure(other)?))
    }

    /// Ratio of the seconds of all stages, where the same processor measured both.
    pub fn time_ratio(&self, reference: &Self) -> Option<Mean> {
        self.against(reference, |row, other| {
            let is_comparable = row["machine"] == other["machine"];
            let ratio = total_seconds(row)? / total_seconds(other)?;
            is_comparable.then_some(ratio)
        })
    }
}

/// Formats a number of seeds, or the smallest and the largest of several scenes.
pub fn seeds<'a>(runs: impl IntoIterator<Item = &'a Runs<'a>>) -> String {
    let count = Mean::of(runs.into_iter().map(|runs| runs.rows.len() as f64));
    count.map_or(String::new(), |count| {
        if count.low == count.high {
            format!("{:.0}", count.low)
        } else {
            format!("{:.0} to {:.0}", count.low, count.high)
        }
    })
}

/// Formats a number with its sign; without one if it is rounded to zero.
pub fn signed(value: f64, digits: usize) -> String {
    let text = format!("{value:+.digits$}");
    if text.contains(|c| matches!(c, '1'..='9')) {
        text
    } else {
        text[1..].to_owned()
    }
}

/// Seconds of all stages of a row.
fn total_seconds(row: &Value) -> Option<f64> {
    let stages = row["seconds"].as_object()?.values();
    Some(stages.filter_map(Value::as_f64).sum())
}

/// Returns the processors, those with the most timed rows first.
pub fn machines(rows: &Rows) -> Vec<&str> {
    let mut found = distinct(rows, "machine");
    let count = |name: &str| {
        rows.rows
            .iter()
            .filter(|row| row["machine"] == name && row["seconds"].is_object())
            .count()
    };
    found.sort_by_key(|name| std::cmp::Reverse(count(name)));
    found
}

/// Returns the distinct texts of a field, in order of their first row.
pub fn distinct<'a>(rows: &'a Rows, field: &str) -> Vec<&'a str> {
    let mut seen = BTreeSet::new();
    let texts = rows.rows.iter().filter_map(|row| row[field].as_str());
    texts.filter(|text| seen.insert(*text)).collect()
}

/// Returns the scenes that have the default way: the given ones.
pub fn given(rows: &Rows) -> Vec<&str> {
    let has_base = |scene: &&str| Runs::of(rows, scene, BASE).is_some();
    distinct(rows, "scene")
        .into_iter()
        .filter(has_base)
        .collect()
}

/// Returns the given scenes with labels.
pub fn labelled(rows: &Rows) -> Vec<&str> {
    let has_labels = |scene: &&str| {
        Runs::of(rows, scene, BASE).is_some_and(|runs| runs.mean("oracle_miou").is_some())
    };
    given(rows).into_iter().filter(has_labels).collect()
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::rows;
    use super::*;
    use serde_json::json;

    #[test]
    fn times_of_two_processors_are_not_mixed() {
        let mut rows = rows();
        rows.rows[0]["machine"] = json!("another");
        let quick = Runs::of(&rows, "fox", BASE).expect("two rows");
        assert_eq!(quick.rows.len(), 2);
        assert_eq!(quick.total_seconds(), Mean::of([15.0]));
        rows.rows[0]["query_ms"] = json!(30.0);
        let quick = Runs::of(&rows, "fox", BASE).expect("two rows");
        assert_eq!(quick.query_milliseconds(), Mean::of([20.0]));
        let standard = Runs::of(&rows, "fox", "standard").expect("a row");
        assert_eq!(standard.time_ratio(&quick), None);
        assert!(standard.change("oracle_miou", &quick).is_some());
    }

    #[test]
    fn zero_has_no_sign() {
        let texts = [-0.04, 0.0, -10.0, 0.3].map(|value| signed(value, 1));
        assert_eq!(texts, ["0.0", "0.0", "-10.0", "+0.3"]);
    }
}
