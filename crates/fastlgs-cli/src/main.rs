//! Entry point of the `fastlgs` binary.

fn main() -> std::process::ExitCode {
    fastlgs_cli::main()
}
