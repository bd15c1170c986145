//! Writes the inputs that fuzzing begins from: `cargo run -p rit-fuzz-checks --example seeds FOLDER`.

use rit_fuzz_checks::{checkpoint::Run, config, frame, starcraft, worker};
use std::{env, error::Error, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    let folder = PathBuf::from(env::args_os().nth(1).ok_or("name a folder")?);
    for (target, seeds) in [
        ("frame", frame::seeds()),
        ("checkpoint", Run::new()?.seeds()),
        ("config", config::seeds()),
        ("worker", worker::seeds()),
        ("starcraft", [starcraft::seeds(), starcraft::refused()].concat()),
    ] {
        let folder = folder.join(target);
        fs::create_dir_all(&folder)?;
        for (name, input) in seeds {
            fs::write(folder.join(name), input)?;
        }
    }
    Ok(())
}
