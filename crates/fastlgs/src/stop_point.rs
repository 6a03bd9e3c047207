//! Stop points: tests kill a stage at an exact step instead of after some time.

use std::sync::OnceLock;

/// Ends the process without any clean-up, like a kill, if `FASTLGS_STOP_AT` is `stage:step`.
pub fn reach(stage: &str, step: u64) {
    static STOP_AT: OnceLock<Option<(String, u64)>> = OnceLock::new();
    let wanted = STOP_AT.get_or_init(|| {
        let text = std::env::var("FASTLGS_STOP_AT").ok()?;
        let (stage, step) = text.rsplit_once(':')?;
        Some((stage.to_owned(), step.parse().ok()?))
    });
    if wanted
        .as_ref()
        .is_some_and(|(at, n)| at == stage && *n == step)
    {
        std::process::abort();
    }
}
