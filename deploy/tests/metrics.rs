//! What a run's users see of it: the stream of metrics and the status, from a real run.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, learner_pid, metrics_lines, output, rit};
use rit_config::RunDir;
use rit_proto::{
    transport::{self, Client, Credentials},
    v1::{MetricsRequest, StatusRequest, control_client::ControlClient, metrics_update::Update},
};
use serde_json::Value;
use std::{fs, path::Path, process::Stdio};

/// A line of metrics an episode.
const RUN: &[&str] = &["matrix-game", "--seed", "3", "--set", "learner.metrics_every_env_steps=2"];

async fn connect(run_dir: &Path) -> ControlClient<Client> {
    let (run_dir, _) = RunDir::open(run_dir).unwrap();
    let address = fs::read_to_string(run_dir.address()).unwrap().trim().parse().unwrap();
    ControlClient::new(transport::connect(&address, &Credentials::token(run_dir.token())).await.unwrap())
}

#[test]
fn a_follower_gets_every_line_until_the_run_is_over() {
    let folder = RunFolder::new();
    let mut train = folder.start(&[RUN, &["--steps", "1000"]].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let run_dir = folder.run_dir();
    let follow =
        ["ctl", "--json", "--run", run_dir.to_str().unwrap(), "metrics", "--follow", "--from", "100"];
    let follower = rit(&follow).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    train.finish();
    let followed = follower.wait_with_output().unwrap();
    assert!(followed.status.success(), "{}", String::from_utf8_lossy(&followed.stderr));
    let text = String::from_utf8(followed.stdout).unwrap();
    let followed: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let mut written = metrics_lines(&run_dir);
    written.retain(|line| line["env_steps"].as_u64() >= Some(100));
    // One an episode, and the evaluation at the end.
    assert_eq!((followed.len(), written.len()), (452, 452));
    assert_eq!((&written[451]["kind"], &written[451]["occasion"]), (&"evaluation".into(), &"final".into()));
    for (line, written) in followed.iter().zip(&written) {
        for key in ["env_steps", "episodes", "updates", "wall_s"] {
            assert_eq!(line[key], written[key], "{key}");
        }
        for measure in line["training"]["measures"].as_array().into_iter().flatten() {
            assert_eq!(measure["value"], written[measure["name"].as_str().unwrap()], "{measure}");
        }
        for task in line["tasks"].as_array().unwrap() {
            let name = task["task"].as_str().unwrap();
            for key in ["episodes", "mean_return", "win_rate", "episodes_total", "policy_lag"] {
                assert_eq!(task[key], written["tasks"][name][key], "{key}");
            }
        }
    }
    let tasks = &followed[450]["tasks"];
    let totals = tasks.as_array().unwrap().iter().map(|task| task["episodes_total"].as_u64().unwrap());
    assert_eq!(totals.sum::<u64>(), 500);
    assert!(tasks.as_array().unwrap().iter().all(|task| task["policy_lag"] == 1), "{tasks}");
}

/// Reads nothing until far more lines have been written than its connection holds.
// On threads of their own, connections answer pings while the test waits.
#[tokio::test(flavor = "multi_thread")]
async fn a_slow_reader_misses_statuses_alone_and_training_does_not_wait() {
    let folder = RunFolder::new();
    let mut train = folder.start(RUN);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let mut control = connect(&folder.run_dir()).await;
    let request = MetricsRequest { from_env_steps: 0, follow: true, status_every_ms: 50 };
    let mut updates = control.metrics(request).await.unwrap().into_inner();
    train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(4000));
    assert!(train.ctl(&["pause"]).status.success());
    let quiet = train.wait_for("quiet", |status| status["ledger"]["inserted"] == status["episodes"]);
    let mut lines = Vec::new();
    while lines.last() != quiet["env_steps"].as_u64().as_ref() {
        if let Some(Update::Line(line)) = updates.message().await.unwrap().unwrap().update {
            lines.push(line.env_steps);
        }
    }
    // The first line is the evaluation at the beginning.
    let expected: Vec<u64> = (0..=quiet["env_steps"].as_u64().unwrap()).step_by(2).collect();
    assert_eq!(lines, expected);
    // Once it has caught up it gets statuses again.
    while !matches!(updates.message().await.unwrap().unwrap().update, Some(Update::Status(_))) {}
    train.ctl(&["stop"]);
    train.finish_stopped();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_status_accounts_for_everything() {
    let folder = RunFolder::new();
    let mut train = folder.start(&[RUN, &["--actors", "2", "--set", "algorithm.buffer_size=100"]].concat());
    train.wait_for("a full replay", |status| status["replay_episodes"] == 100);
    assert!(train.ctl(&["checkpoint"]).status.success());
    assert!(train.ctl(&["pause"]).status.success());
    let before = train.wait_for("quiet", |status| status["ledger"]["inserted"] == status["episodes"]);
    let mut control = connect(&folder.run_dir()).await;
    let status = control.status(StatusRequest {}).await.unwrap().into_inner();
    assert_eq!(u64::from(status.pid), u64::from(learner_pid(&before)));
    let ledger = status.ledger.unwrap();
    assert_eq!((ledger.handed_out, ledger.imbalances), (ledger.inserted + ledger.outstanding, 0));
    assert_eq!((status.replay_episodes, status.replay_episodes_max), (100, 100));
    let totals = status.recent.iter().map(|task| task.episodes_total.unwrap());
    assert_eq!(totals.sum::<u64>(), status.episodes);
    // Every frame of the matrix game has the same length: its header, and what its dims make.
    let layout = rit_episode::wire::PayloadLayout::new(rit_env::TaskSet::MatrixGame.dims());
    assert_eq!(status.shared_memory_bytes, status.episodes * (88 + layout.len() as u64));
    let checkpoints = status.checkpoints.unwrap();
    assert_eq!((checkpoints.written, checkpoints.failed), (1, 0));
    assert!(checkpoints.last_s > 0.0 && checkpoints.total_s == checkpoints.last_s);
    // One side always waits: two actors are more than this learner needs, or fewer.
    let waited: f64 = status.actors.iter().map(|actor| actor.waiting_s).sum();
    assert!(waited + status.learner_waiting_s > 0.0);
    // A pause counts as no one's waiting.
    let later = control.status(StatusRequest {}).await.unwrap().into_inner();
    assert_eq!(later.learner_waiting_s, status.learner_waiting_s);
    for (then, now) in status.actors.iter().zip(&later.actors) {
        assert_eq!(then.waiting_s, now.waiting_s);
    }
    let happened: Vec<_> = later.happenings.iter().map(|happening| happening.what.as_str()).collect();
    for what in ["actor-0 joined", "actor-1 joined", "wrote the checkpoint at", "paused"] {
        assert!(happened.iter().any(|happening| happening.starts_with(what)), "{what} in {happened:?}");
    }
    train.ctl(&["stop"]);
    train.finish_stopped();
}

#[test]
fn people_get_lines() {
    let folder = RunFolder::new();
    let mut train = folder.start(RUN);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    let run_dir = folder.run_dir();
    let printed = output(&["ctl", "--run", run_dir.to_str().unwrap(), "metrics"]);
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(text.lines().count() > 10, "{text}");
    assert!(text.starts_with("0 steps · 0 updates · greedy: return "), "{text}");
    assert!(text.contains("td loss ") && text.contains("epsilon 0."), "{text}");
    train.ctl(&["stop"]);
    train.finish_stopped();
}
