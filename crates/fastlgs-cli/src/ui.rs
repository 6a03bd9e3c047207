//! Options of all commands, and logging.

use clap::builder::{PossibleValuesParser, TypedValueParser};
use fastlgs::Run;
use fastlgs::progress::Sink;
use fastlgs_vision::Provider;
use std::io::IsTerminal;
use std::path::PathBuf;
use tracing_subscriber::EnvFilter;

/// Options of all commands.
#[derive(clap::Args, Clone)]
pub struct Common {
    /// Print more messages; twice: debug messages.
    #[arg(short, long, action = clap::ArgAction::Count, global = true)]
    pub verbose: u8,
    /// Print only errors.
    #[arg(short, long, global = true)]
    pub quiet: bool,
    /// Write the report as JSON to FILE, or to standard output with `-`.
    #[arg(long, value_name = "FILE", global = true)]
    pub json: Option<PathBuf>,
    /// Seed of all random numbers.
    #[arg(long, default_value_t = 0, global = true)]
    pub seed: u64,
    /// Device: `auto`, `cpu`, or the name or index of an adapter (`fastlgs info` lists them).
    /// `auto` uses a graphics card if there is one, else `cpu`.
    #[arg(long, default_value = "auto", global = true, env = "FASTLGS_DEVICE")]
    pub device: String,
    /// Hardware for the models, through ONNX Runtime. `auto` uses CUDA, CoreML or DirectML if the
    /// library has it and it works, else the processor.
    #[arg(long, value_name = "PROVIDER", default_value = "auto", global = true, hide = true, env = "FASTLGS_ONNX",
        value_parser = PossibleValuesParser::new(Provider::NAMES).map(provider))]
    pub onnx: Provider,
}

/// Returns the provider of a name that was checked before.
fn provider(name: String) -> Provider {
    Provider::by_name(&name).unwrap_or_default()
}

impl Common {
    /// Returns the run settings of a stage that reports to `progress`.
    pub fn run<'a>(&'a self, progress: &'a dyn Sink) -> Run<'a> {
        Run {
            device: &self.device,
            seed: self.seed,
            progress,
        }
    }
}

/// Starts logging to stderr. The environment variable `FASTLGS_LOG` overrides `--verbose` and
/// `--quiet`.
pub fn start_logging(common: &Common) {
    let level = match (common.quiet, common.verbose) {
        (true, _) => "error",
        (_, 0) => "warn",
        (_, 1) => "info,wgpu_core=warn,wgpu_hal=error,ort=warn",
        _ => "debug,wgpu_core=info,wgpu_hal=warn,naga=info",
    };
    let level = if common.verbose == 0 {
        format!("{level},wgpu_hal=error,ort=error")
    } else {
        level.to_owned()
    };
    let filter = EnvFilter::try_from_env("FASTLGS_LOG").unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_target(false)
        .without_time()
        .with_ansi(std::io::stderr().is_terminal())
        .init();
}

/// Writes a line to standard output. A closed pipe, such as after `head`, is not an error.
///
/// # Errors
/// Any other I/O error, such as a full disk.
pub fn write_line(words: std::fmt::Arguments<'_>) -> std::io::Result<()> {
    use std::io::Write;
    match writeln!(std::io::stdout(), "{words}") {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

/// Prints a line to standard output and ignores errors.
macro_rules! print_line {
    ($($words:tt)*) => {
        drop($crate::ui::write_line(format_args!($($words)*)))
    };
}
pub(crate) use print_line;
