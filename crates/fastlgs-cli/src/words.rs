//! Reports of the stages in words: a short table with units. `--json` has everything.

use fastlgs::eval::Outcome;
use fastlgs_serve::share;

/// Lines of a name and what there is to say; lines without anything to say are left out.
pub fn table(lines: &[(&str, String)]) -> String {
    let said = || lines.iter().filter(|(_, words)| !words.is_empty());
    let width = said().map(|(name, _)| name.len()).max().unwrap_or(0);
    said().map(|(name, words)| format!("{name:width$}  {words}")).collect::<Vec<_>>().join("\n")
}

/// 19580 as 19,580.
pub fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> = digits.as_bytes().rchunks(3).rev().map(|g| std::str::from_utf8(g).unwrap_or_default()).collect();
    groups.join(",")
}

/// Bytes in millions.
pub fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

fn decibels(psnr: Option<f64>) -> String {
    psnr.map(|psnr| format!("{psnr:.2} dB")).unwrap_or_default()
}

pub fn preprocess(r: &fastlgs::preprocess::Report) -> String {
    let adjusted = r.adjusted.as_ref().map(|a| {
        let verdict = if a.used { "all cameras were adjusted" } else { "adjusting them all gains nothing" };
        format!("; {verdict} (key points off by {:.2} px before, {:.2} after)", a.error_before, a.error_after)
    });
    let there: usize = r.cached.values().map(|c| c[0]).sum();
    let reused = if there > 0 { format!(", {} results of an earlier run were kept", thousands(there)) } else { String::new() };
    let brightness = format!("differs by {:.2} stops from photo to photo", r.brightness_spread_stops);
    table(&[
        ("scene", r.scene.display().to_string()),
        ("photos", format!("{} of {} to train on, {} kept aside", r.training_photos, r.size, r.held_out)),
        ("masks", thousands(r.masks)),
        ("poses", format!("{} cameras were moved{}", r.moved_cameras, adjusted.unwrap_or_default())),
        ("points", format!("{} to start from, {} pairs of key points", thousands(r.points), thousands(r.key_point_matches))),
        ("brightness", if r.brightness_spread_stops >= 0.15 { brightness } else { String::new() }),
        ("time", format!("{:.0} s{reused}", r.seconds_total)),
    ])
}

pub fn remove(r: &fastlgs::remove::Report) -> String {
    table(&[
        ("scene", format!("{}, with {} objects and parts", r.output.display(), thousands(r.left))),
        ("removed", format!("{} Gaussians", thousands(r.removed))),
        ("behind it", format!("{:.0} % were seen by other photos; {} Gaussians fill the rest", 100.0 * r.seen, thousands(r.filled))),
    ])
}

pub fn train(r: &fastlgs::train::Report) -> String {
    let held_out = decibels(r.psnr_held_out);
    let colour = if held_out.is_empty() {
        "no photos were kept aside to measure it".to_owned()
    } else {
        format!("{held_out} on photos that were kept aside")
    };
    let dropped = r.mapping_summary.as_ref().map(|s| {
        let left_out = s.few_views + s.unsupported + s.same;
        format!(", of {} masks; {left_out} candidates had too little behind them", thousands(s.masks))
    });
    let clear = if r.clear > 0 { format!(", {} of them clear, for what photos see through", thousands(r.clear)) } else { String::new() };
    table(&[
        ("scene", r.scene.display().to_string()),
        ("Gaussians", format!("{}, colour of degree {}{clear}", thousands(r.gaussians), r.sh_degree)),
        ("colour", colour),
        ("objects", format!("{} and parts{}", thousands(r.objects), dropped.unwrap_or_default())),
        (
            "time",
            format!(
                "{:.0} s for {} iterations of {}, {:.0} s for objects{}",
                r.seconds,
                thousands(r.iterations as usize),
                r.size,
                r.mapping_seconds,
                r.mapping_summary.as_ref().map_or_else(String::new, |s| format!(" in {} MB", s.megabytes + 1))
            ),
        ),
        ("device", format!("{} ({})", r.adapter, r.device.why)),
    ])
}

pub fn render(r: &fastlgs::render::Report) -> String {
    let mean = r.render_ms.iter().sum::<f64>() / r.render_ms.len().max(1) as f64;
    let mut lines: Vec<String> = r.files.iter().map(|file| file.display().to_string()).collect();
    let views = r.render_ms.len();
    lines.push(format!("{views} view{} of {}, {mean:.0} ms each ({})", if views == 1 { "" } else { "s" }, r.size, r.adapter));
    lines.join("\n")
}

pub fn export(r: &fastlgs::export::Report) -> String {
    let r = match r {
        fastlgs::export::Report::Path { output, frames, .. } => return format!("{}: a camera path of {frames} views", output.display()),
        fastlgs::export::Report::Scene(scene) => scene,
    };
    let quality = match (r.psnr_held_out.before, r.psnr_held_out.after) {
        (Some(before), Some(after)) => format!("{after:.2} dB on photos that were kept aside, {before:.2} before"),
        _ => format!("pictures are within {:.1} dB of the scene's own", r.psnr_against_original),
    };
    table(&[
        ("written", format!("{}, {}", r.output.display(), megabytes(r.bytes))),
        ("scene", format!("{}, of which queries need {}", r.scene.display(), megabytes(r.bytes_before))),
        ("Gaussians", format!("{}, colour of degree {}", thousands(r.gaussians), r.sh_degree)),
        ("colour", quality),
    ])
}

pub fn share(r: &share::Report) -> String {
    let folder = r.output.display();
    let said = table(&[
        ("written", format!("{folder}, {}, for any web server", megabytes(r.bytes))),
        ("Gaussians", thousands(r.gaussians)),
        ("words", format!("{} are answered; {} of them name something in the scene", thousands(r.words), thousands(r.found))),
    ]);
    format!("{said}\n\ntry it:  python3 -m http.server -d {folder}")
}

pub fn synth(r: &fastlgs::synth::Report) -> String {
    let photos = r.photos.display();
    format!(
        "{photos}: {} photos of {} of '{}', with exact poses, depths, masks and labels\nin it: {}",
        r.views,
        r.size,
        r.kind,
        r.objects.join(", ")
    )
}

pub fn teach(r: &fastlgs::teach::Report) -> String {
    let shown = r.object.map_or_else(|| "a picture".to_owned(), |id| format!("object {id}"));
    format!("\"{}\" is {shown} from now on, by {} views; {} examples of it are kept in {}", r.name, r.views, r.examples, r.kept.display())
}

pub fn eval(r: &fastlgs::eval::Report) -> String {
    let two = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |v| format!("{v:.2}"));
    let aligned = r.psnr_aligned.map(|p| format!(", {p:.2} with their poses aligned")).unwrap_or_default();
    let colour =
        r.psnr.map(|_| format!("{}{aligned}, SSIM {:.3}, on photos that were kept aside", decibels(r.psnr), r.ssim.unwrap_or_default()));
    let labelled = r.labels_scored > 0;
    let only = |words: String| if labelled { words } else { String::new() };
    let outcomes = r.outcomes.iter().map(|(outcome, count)| {
        let words = match outcome {
            Outcome::Right => "right",
            Outcome::Refused => "refused",
            Outcome::WrongLevel => "at the wrong level",
            Outcome::WrongObject => "of another object",
            Outcome::WrongMask => "with a wrong mask",
        };
        format!("{count} {words}")
    });
    let coloured = r.absent_colored_rejected.map(|share| format!(", with colours {:.0} %", 100.0 * share)).unwrap_or_default();
    let mut text = table(&[
        (
            "scene",
            format!(
                "{}: {} Gaussians, {} objects and parts, {:.1} MB",
                r.scene.display(),
                thousands(r.gaussians),
                thousands(r.objects),
                r.scene_bytes as f64 / 1e6
            ),
        ),
        ("colour", colour.unwrap_or_default()),
        (
            "objects",
            only(format!("mIoU {} of the best one for each of {} labels in {} views", two(r.oracle_miou), r.labels_scored, r.views_scored)),
        ),
        ("texts", only(format!("mIoU {}: {}", two(r.miou), outcomes.collect::<Vec<_>>().join(", ")))),
        (
            "absent",
            only(format!("{} of {} names are not found{coloured}; AUROC {}", r.absent_rejected, r.absent_texts, two(r.absent_auroc))),
        ),
        (
            "query",
            r.query_ms_first
                .map(|first| {
                    format!(
                        "{first:.0} ms for the first text in a view, {:.0} ms for the next ({})",
                        r.query_ms_next.unwrap_or_default(),
                        r.adapter
                    )
                })
                .unwrap_or_default(),
        ),
    ]);
    let width = r.oracle_by_label.keys().map(|name| name.chars().count()).max().unwrap_or(0);
    for (name, oracle) in &r.oracle_by_label {
        let asked = two(r.miou_by_label.get(name).copied().flatten());
        let place = r.oracle_rank_by_label.get(name).map(|rank| format!(", which is number {rank} for it")).unwrap_or_default();
        text += &format!("\n  {name:width$}  text {asked}, best object {}{place}", two(*oracle));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_are_short_tables() {
        let made = fastlgs::train::Report {
            gaussians: 28782,
            objects: 596,
            seconds: 87.2,
            iterations: 2000,
            size: "270x480".into(),
            ..Default::default()
        };
        let said = train(&fastlgs::train::Report { psnr_held_out: Some(31.932), ..made.clone() });
        assert!(
            said.contains("Gaussians  28,782") && said.contains("31.93 dB on photos") && said.contains("87 s for 2,000 iterations"),
            "{said}"
        );
        assert!(train(&made).contains("no photos were kept aside"));
        let some = |v: f64| Some(v);
        let plain = fastlgs::eval::Report { gaussians: 12, objects: 3, ..Default::default() };
        assert_eq!(eval(&plain).lines().count(), 1, "what was not measured is not told: {}", eval(&plain));
        let labelled = fastlgs::eval::Report {
            labels_scored: 2,
            views_scored: 1,
            miou: some(0.4),
            oracle_miou: some(0.875),
            outcomes: [(Outcome::Right, 1), (Outcome::Refused, 1)].into(),
            oracle_by_label: [("fox".to_owned(), some(0.83))].into(),
            miou_by_label: [("fox".to_owned(), some(0.7))].into(),
            oracle_rank_by_label: [("fox".to_owned(), 4)].into(),
            ..plain
        };
        let said = eval(&labelled);
        for words in [
            "mIoU 0.88 of the best one for each of 2 labels",
            "1 right, 1 refused",
            "fox  text 0.70, best object 0.83, which is number 4 for it",
        ] {
            assert!(said.contains(words), "'{words}' is missing: {said}");
        }
        assert_eq!([7, 1234, 1234567].map(thousands), ["7", "1,234", "1,234,567"]);
    }
}
