//! The `fastlgs` binary.

fn main() -> std::process::ExitCode {
    fastlgs_cli::main()
}
