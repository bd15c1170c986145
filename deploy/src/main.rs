//! The `rit` binary: the program with the task sets that come with it.

use std::process::ExitCode;

fn main() -> ExitCode {
    rit::Program::new().main()
}
