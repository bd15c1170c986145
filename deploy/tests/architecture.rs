//! What ARCHITECTURE.md says that parts do not know of each other: read from the manifests and the sources.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// Each crate's folder, and those of ours that it may depend on.
const CRATES: &[(&str, &[&str])] = &[
    ("common/episode", &[]),
    ("common/env", &["rit-episode"]),
    ("common/nn", &[]),
    ("common/algo", &["rit-episode", "rit-nn"]),
    ("common/ipc", &["rit-episode"]),
    ("common/config", &["rit-algo", "rit-env", "rit-episode", "rit-nn"]),
    ("common/policy", &["rit-algo", "rit-config", "rit-episode", "rit-nn"]),
    ("common/onnx", &["rit-algo", "rit-policy"]),
    ("common/record", &["rit-algo", "rit-config", "rit-env"]),
    ("common/worlds", &["rit-config", "rit-env", "rit-foreign", "rit-starcraft"]),
    ("proto", &[]),
    (
        "actor",
        &[
            "rit-algo",
            "rit-config",
            "rit-env",
            "rit-episode",
            "rit-ipc",
            "rit-proto",
            "rit-record",
            "rit-worlds",
        ],
    ),
    (
        "learner",
        &[
            "rit-algo",
            "rit-config",
            "rit-env",
            "rit-episode",
            "rit-ipc",
            "rit-nn",
            "rit-policy",
            "rit-proto",
            "rit-record",
            "rit-worlds",
        ],
    ),
];

/// Dependencies by which a crate would speak to a network, run tasks or read a clock.
const TRANSPORT: &[&str] =
    &["axum", "hyper", "iceoryx2", "prost", "tokio", "tonic", "tower", "rit-proto", "rit-ipc"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// Names of a crate's dependencies, those of its tests left out.
fn dependencies(folder: &str) -> Vec<String> {
    let manifest = fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap();
    let manifest: toml::Table = manifest.parse().unwrap();
    manifest["dependencies"].as_table().unwrap().keys().cloned().collect()
}

/// Lines of code of every source below a folder, by file: no comments, and no tests, which stand at the end of a file or
/// in one of their own.
fn code(folder: &str) -> BTreeMap<String, Vec<String>> {
    fn files(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                files(&path, found);
            } else if path.extension().is_some_and(|ending| ending == "rs") && !path.ends_with("tests.rs") {
                found.push(path);
            }
        }
    }
    let mut found = Vec::new();
    files(&root().join(folder), &mut found);
    assert!(!found.is_empty(), "{folder} is where it was");
    let read = |path: PathBuf| {
        let text = fs::read_to_string(&path).unwrap();
        let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
        let lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let name = path.strip_prefix(root()).unwrap().display().to_string();
        (name, lines.map(str::to_owned).collect())
    };
    found.into_iter().map(read).collect()
}

/// Every crate's code.
fn all_code() -> BTreeMap<String, Vec<String>> {
    CRATES
        .iter()
        .map(|(folder, _)| *folder)
        .chain(["deploy"])
        .flat_map(|folder| code(&format!("{folder}/src")))
        .collect()
}

/// The files with a line that holds one of these.
fn holding(code: BTreeMap<String, Vec<String>>, words: &[&str]) -> Vec<String> {
    let holds = |lines: &[String]| lines.iter().any(|line| words.iter().any(|word| line.contains(word)));
    code.into_iter().filter(|(_, lines)| holds(lines)).map(|(name, _)| name).collect()
}

#[test]
fn dependencies_run_one_way() {
    for (folder, allowed) in CRATES {
        for name in dependencies(folder).iter().filter(|name| name.starts_with("rit-")) {
            assert!(allowed.contains(&name.as_str()), "{folder} depends on {name}");
        }
    }
}

#[test]
fn environments_and_networks_and_algorithms_know_no_transport() {
    for folder in ["common/episode", "common/env", "common/nn", "common/algo"] {
        let found: Vec<_> =
            dependencies(folder).into_iter().filter(|name| TRANSPORT.contains(&name.as_str())).collect();
        assert!(found.is_empty(), "{folder} depends on {found:?}");
        let io = ["std::fs", "std::net", "std::process", "std::io", "Instant::now", "SystemTime::now"];
        let found = holding(code(&format!("{folder}/src")), &io);
        assert!(found.is_empty(), "{found:?} reads files, sockets or clocks");
    }
}

#[test]
fn machines_that_decide_know_no_clock_file_socket_or_process() {
    // Around them are their shells, and in the simulator a world of models.
    let code: BTreeMap<_, _> = code("deploy/src").into_iter().chain(code("learner/src")).collect();
    let shells = [
        "deploy/src/supervisor/process.rs",
        "deploy/src/supervisor/shell.rs",
        "learner/src/coordinator/shell.rs",
    ];
    let machines = ["deploy/src/supervisor", "learner/src/coordinator", "learner/src/ledger"];
    let decides =
        |name: &str| machines.iter().any(|machine| name.starts_with(machine)) && !shells.contains(&name);
    let machines: BTreeMap<_, _> = code.into_iter().filter(|(name, _)| decides(name)).collect();
    assert!(machines.len() > 10, "they are where they were: {:?}", machines.keys());
    let effects = [
        "Instant",
        "SystemTime",
        "fs::",
        "std::io",
        "std::net",
        "tokio",
        "Command::new",
        "thread::",
        "std::env",
    ];
    let found = holding(machines, &effects);
    assert!(found.is_empty(), "{found:?} does what is a shell's");
}

#[test]
fn worlds_know_no_decision_order() {
    // What seats agents, and the loop that draws the seats.
    let found = holding(code("common/env/src"), &["DecisionOrder", "decision_order"]);
    assert_eq!(found, ["common/env/src/rollout.rs", "common/env/src/seated.rs"]);
}

#[test]
fn libraries_stay_where_they_are() {
    for (library, home) in [("iceoryx2", "common/ipc"), ("faer", "common/nn"), ("tonic", "")] {
        for (folder, _) in CRATES {
            let depends = dependencies(folder).iter().any(|name| name == library);
            let may = *folder == home || (home.is_empty() && ["proto", "actor", "learner"].contains(folder));
            assert!(!depends || may, "{folder} depends on {library}");
        }
    }
    assert!(!dependencies("deploy").iter().any(|name| ["iceoryx2", "faer"].contains(&name.as_str())));
}

#[test]
fn generated_types_stay_at_the_edges() {
    // Those that speak gRPC, and those that make messages of what they hold; none keeps a message as its state.
    let edges = [
        "actor/src/losses.rs",
        "actor/src/rollout.rs",
        "actor/src/run.rs",
        "actor/src/sink.rs",
        "actor/src/weights.rs",
        "learner/src/control_service.rs",
        "learner/src/coordinator/shell.rs",
        "learner/src/coordinator/status.rs",
        "learner/src/episodes_service.rs",
        "learner/src/messages.rs",
        "learner/src/prometheus.rs",
        "learner/src/rollout_service.rs",
        "learner/src/run.rs",
        "learner/src/run_handle.rs",
        "learner/src/web/api.rs",
        "learner/src/weights.rs",
    ];
    let code: BTreeMap<_, _> = code("actor/src").into_iter().chain(code("learner/src")).collect();
    assert_eq!(holding(code, &["v1"]), edges);
}

#[test]
fn padding_is_for_frames_alone() {
    // The wire pads and unpads; the log of replay holds the wire's frames as they are.
    let found = holding(all_code(), &["wire::encode(", "wire::decode(", "Frame::new("]);
    let frames = [
        "actor/src/rollout.rs",
        "common/episode/src/wire.rs",
        "deploy/src/bench/ipc.rs",
        "learner/src/episodes_service.rs",
        "learner/src/receive.rs",
        "learner/src/replay_log.rs",
    ];
    for file in &found {
        assert!(frames.contains(&file.as_str()), "{file} handles frames");
    }
}

#[test]
fn only_shared_memory_is_unsafe() {
    let found = holding(all_code(), &["unsafe {", "unsafe fn", "unsafe impl", "allow(unsafe_code"]);
    assert!(found.iter().all(|file| file.starts_with("common/ipc/")), "{found:?}");
}

#[test]
fn what_lies_in_a_run_directory_is_opened_as_a_regular_file() {
    // Whatever lies in the place of a file, a pipe or a device, no command waits at it.
    let ways = [
        "fs::read(",
        "fs::read_to_string(",
        " File::open(",
        "(File::open(",
        " File::create(",
        "(File::create(",
        "fs::write(",
        ").open(",
        "options.open(",
    ];
    let other = [
        // The one way itself.
        "common/config/src/regular_file.rs",
        // New files, which are made or not there.
        "common/config/src/owned_run_dir.rs",
        "deploy/src/beginning.rs",
        "deploy/src/certificates.rs",
        "deploy/src/comparison.rs",
        "deploy/src/new_file.rs",
        // A log beside the run.
        "deploy/src/soak/fire.rs",
        "learner/src/tensorboard.rs",
        // Folders.
        "common/config/src/run_lock.rs",
        "deploy/src/sweep/mod.rs",
        "learner/src/checkpoint.rs",
        "learner/src/replay_log.rs",
        // What the system tells of processes, and of itself.
        "common/record/src/machine.rs",
        "deploy/src/bench/learner.rs",
        "deploy/src/bench/scale.rs",
        "deploy/src/child.rs",
        "deploy/src/shutdown.rs",
        // Secrets, which are looked at first.
        "proto/src/transport/files.rs",
    ];
    let mut found = holding(all_code(), &ways);
    // Shared memory lies in no run directory.
    found.retain(|file| !file.starts_with("common/ipc/") && !other.contains(&file.as_str()));
    assert!(found.is_empty(), "use rit_config::open_regular, read_text or write_whole: {found:?}");
}
