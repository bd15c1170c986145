//! A run whose losses are no longer finite ends before a number of it reaches the weights, a checkpoint or an actor.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output};
use serde_json::Value;

/// ROMA's roles have a variance that grows exponentially with what its encoder says. The largest learning rate there is
/// makes that infinite in the second update of the matrix game.
#[test]
fn a_run_that_diverges_fails_and_its_last_checkpoint_stays_usable() {
    let folder = RunFolder::new();
    let diverging = folder.start(
        &[
            &["matrix-game", "--algorithm", "roma", "--seed", "3", "--steps", "2000", "--actors", "1"][..],
            &[
                "--set",
                "algorithm.lr=1",
                "--set",
                "evaluation.episodes=1",
                "--set",
                "checkpoints.every_env_steps=8",
            ],
        ]
        .concat(),
    );
    let run_dir = folder.run_dir();
    let ended = diverging.wait();
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("is not finite in update 2: training has diverged"), "{stderr}");
    assert!(stderr.contains("--set algorithm.lr="), "{stderr}");
    let summary: Value =
        serde_json::from_slice(&std::fs::read(run_dir.join("summary.json")).unwrap()).unwrap();
    assert_eq!((&summary["ended"], &summary["diverged"]), (&"failed".into(), &true.into()));
    let evaluated = output(&["evaluate", "--run", run_dir.to_str().unwrap(), "--episodes", "2", "--json"]);
    assert!(evaluated.status.success(), "{}", String::from_utf8_lossy(&evaluated.stderr));
    let evaluation: Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    for game in ["game-1", "game-2", "game-3", "game-4"] {
        let mean_return = &evaluation["tasks"][game]["mean_return"];
        assert!(mean_return.as_f64().is_some_and(f64::is_finite), "{evaluation}");
    }
}
