//! What ARCHITECTURE.md says that parts do not know of each other: read from the manifests and the sources.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use rit_algo::{Method, Model};
use std::{
    collections::{BTreeMap, BTreeSet},
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
    ("common/statistics", &["rit-episode"]),
    ("common/report", &["rit-algo", "rit-config", "rit-env", "rit-episode", "rit-record", "rit-statistics"]),
    ("common/foreign", &["rit-config", "rit-env", "rit-episode"]),
    ("common/starcraft", &["rit-env", "rit-episode"]),
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
    // These may depend on all; on the fuzz targets' checks and on the example nothing does.
    ("deploy", LIBRARIES),
    ("common/fuzz/checks", LIBRARIES),
    ("deploy/examples/corridor", &["rit"]),
];

/// Every crate but the program itself, and what only tests it or shows how it is used.
const LIBRARIES: &[&str] = &[
    "rit-actor",
    "rit-algo",
    "rit-config",
    "rit-env",
    "rit-episode",
    "rit-foreign",
    "rit-ipc",
    "rit-learner",
    "rit-nn",
    "rit-onnx",
    "rit-policy",
    "rit-proto",
    "rit-record",
    "rit-report",
    "rit-starcraft",
    "rit-statistics",
    "rit-worlds",
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

/// Folders of the workspace's members, as its manifest has them.
fn members() -> Vec<String> {
    let manifest: toml::Table = fs::read_to_string(root().join("Cargo.toml")).unwrap().parse().unwrap();
    let list = |key: &str| -> Vec<String> {
        let folders = manifest["workspace"][key].as_array().unwrap();
        folders.iter().map(|folder| folder.as_str().unwrap().to_owned()).collect()
    };
    let mut members = Vec::new();
    for pattern in list("members") {
        let Some(folder) = pattern.strip_suffix("/*") else {
            members.push(pattern);
            continue;
        };
        for entry in fs::read_dir(root().join(folder)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let member = format!("{folder}/{name}");
            if root().join(&member).join("Cargo.toml").is_file() {
                members.push(member);
            }
        }
    }
    let excluded = list("exclude");
    members.retain(|member| !excluded.contains(member));
    members.sort();
    members
}

/// Lines of code of every source below a folder, by file: no comments, and no tests, which stand at the end of a file or
/// in one, or a folder, of their own.
fn code(folder: &str) -> BTreeMap<String, Vec<String>> {
    fn files(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.ends_with("tests") || path.ends_with("tests.rs") {
                continue;
            }
            if path.is_dir() {
                files(&path, found);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
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
        let lines = without_test_items(text);
        let lines = lines.into_iter().filter(|line| !line.trim_start().starts_with("//"));
        let name = path.strip_prefix(root()).unwrap().display().to_string();
        (name, lines.map(str::to_owned).collect())
    };
    found.into_iter().map(read).collect()
}

/// A source's lines without what else is there for tests alone: an item, which ends as far in as it begins.
fn without_test_items(text: &str) -> Vec<&str> {
    let mut kept = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let Some(indent) = line.strip_suffix("#[cfg(test)]") else {
            kept.push(line);
            continue;
        };
        let is_end = |line: &str| match line.strip_prefix(indent) {
            Some(behind) => !behind.starts_with(' ') && behind.ends_with([';', ',', '}']),
            None => !line.is_empty(),
        };
        let _ = lines.find(|line| is_end(line));
    }
    kept
}

/// Every crate's code.
fn all_code() -> BTreeMap<String, Vec<String>> {
    CRATES.iter().flat_map(|(folder, _)| code(&format!("{folder}/src"))).collect()
}

/// The files with a line that holds one of these.
fn holding(code: BTreeMap<String, Vec<String>>, words: &[&str]) -> Vec<String> {
    let holds = |lines: &[String]| lines.iter().any(|line| words.iter().any(|word| line.contains(word)));
    code.into_iter().filter(|(_, lines)| holds(lines)).map(|(name, _)| name).collect()
}

/// What is not listed, no test here looks at.
#[test]
fn every_crate_is_looked_at() {
    let mut listed: Vec<&str> = CRATES.iter().map(|(folder, _)| *folder).collect();
    listed.sort_unstable();
    assert_eq!(listed, members());
}

#[test]
fn dependencies_run_one_way() {
    for (folder, allowed) in CRATES {
        let names = dependencies(folder);
        let ours = names.iter().filter(|name| *name == "rit" || name.starts_with("rit-"));
        for name in ours {
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
            let speaks = ["proto", "actor", "learner", "deploy"];
            let may = *folder == home || (home.is_empty() && speaks.contains(folder));
            assert!(!depends || may, "{folder} depends on {library}");
        }
    }
}

/// Whatever writes, sends or shows what an update reports goes through the list that its method declares: a new measure is
/// named where it is made, and nowhere else.
#[test]
fn what_shows_measures_knows_none_by_name() {
    let measures = every_measure();
    assert!(measures.contains("td_loss") && measures.contains("policy_loss"));
    let mut sources: BTreeMap<String, Vec<String>> =
        ["common/record", "common/report", "proto", "actor", "learner", "deploy"]
            .iter()
            .flat_map(|folder| code(&format!("{folder}/src")))
            .collect();
    for folder in ["proto/rit/v1", "learner/src/web/assets", "deploy/grafana"] {
        for entry in fs::read_dir(root().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let text = fs::read_to_string(&path).unwrap();
            // Fields that messages once had keep their names to themselves.
            let lines = text.lines().filter(|line| !line.trim_start().starts_with("reserved "));
            sources.insert(path.display().to_string(), lines.map(str::to_owned).collect());
        }
    }
    let is_part_of_a_word = |letter: char| letter.is_alphanumeric() || letter == '_';
    let names = |line: &String| {
        line.split(|letter: char| !is_part_of_a_word(letter)).any(|word| measures.contains(word))
    };
    let found: Vec<_> = sources.iter().filter(|(_, lines)| lines.iter().any(names)).collect();
    let found: Vec<_> = found.into_iter().map(|(name, _)| name).collect();
    assert!(found.is_empty(), "{found:?} name a measure");
}

/// What updates of all methods report, by name.
fn every_measure() -> BTreeSet<&'static str> {
    let of_method = |method: Method| {
        let name = rit_config::set(&format!("algorithm.name={method}")).unwrap();
        let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[name]).unwrap();
        let model = Model::new(config.model()).unwrap();
        let params = vec![0.0; model.layout().len()];
        let learner = model.learner(config.update(), params).unwrap();
        learner.measures().iter().map(|measure| measure.name).collect::<Vec<_>>()
    };
    Method::ALL.into_iter().flat_map(of_method).collect()
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
        "common/fuzz/checks/src/frame.rs",
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
    let outside = ["deploy/python/src", "common/fuzz/fuzz_targets"].map(code);
    let all = all_code().into_iter().chain(outside.into_iter().flatten()).collect();
    let found = holding(all, &["unsafe {", "unsafe fn", "unsafe impl", "allow(unsafe_code"]);
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
        // What an installed game holds, and what one has printed into a folder made for it.
        "common/starcraft/src/process.rs",
        "common/starcraft/src/worlds.rs",
        // Fuzzing damages a run that it has made.
        "common/fuzz/checks/src/checkpoint.rs",
        // Secrets, which are looked at first.
        "proto/src/transport/files.rs",
    ];
    let mut found = holding(all_code(), &ways);
    // Shared memory lies in no run directory.
    found.retain(|file| !file.starts_with("common/ipc/") && !other.contains(&file.as_str()));
    assert!(found.is_empty(), "use rit_config::open_regular, read_text or write_whole: {found:?}");
}

/// The modules of `algo` depend on each other in one direction: objectives do not know methods, methods do not know the
/// model that names them all.
#[test]
fn no_circle_of_modules_is_left_in_algo() {
    let mut knows: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let sources = code("common/algo/src");
    let exports = exports(&sources["common/algo/src/lib.rs"].join("\n"));
    for (file, lines) in &sources {
        let module = file.trim_start_matches("common/algo/src/").trim_end_matches(".rs");
        let module = module.split('/').next().unwrap();
        if module == "lib" {
            continue;
        }
        let known = knows.entry(module.to_owned()).or_default();
        let names = paths(&lines.join("\n"), "crate::").into_iter().map(|path| path[0].clone());
        known.extend(names.map(|name| exports.get(&name).unwrap_or(&name).clone()));
        known.remove(module);
    }
    assert!(knows["model"].contains("methods") && knows["methods"].contains("drive"), "{knows:?}");
    // Modules that know none of those that are left are taken away; a circle stays.
    while let Some(last) = knows.iter().find(|(_, known)| known.iter().all(|name| !knows.contains_key(name)))
    {
        let last = last.0.clone();
        knows.remove(&last);
    }
    assert!(knows.is_empty(), "these know each other in a circle: {knows:?}");
}

/// The module that each name comes from which a crate's root passes on.
fn exports(root: &str) -> BTreeMap<String, String> {
    let used = root.split("pub use ").skip(1).filter_map(|rest| rest.split(';').next());
    let names = used.flat_map(|tree| paths(&format!("crate::{tree}"), "crate::"));
    names.map(|path| (path.last().unwrap().clone(), path[0].clone())).collect()
}

/// All paths after `prefix`, those of trees in braces each by itself.
fn paths(code: &str, prefix: &str) -> Vec<Vec<String>> {
    code.split(prefix).skip(1).flat_map(|rest| tree(&mut rest.chars().peekable())).collect()
}

/// The paths of one tree: `a::{b, c::d}` is a::b and a::c::d.
fn tree(rest: &mut std::iter::Peekable<std::str::Chars<'_>>) -> Vec<Vec<String>> {
    let mut name = String::new();
    while let Some(&letter) = rest.peek() {
        match letter {
            letter if letter.is_alphanumeric() || letter == '_' => name.push(letter),
            letter if letter.is_whitespace() && name.is_empty() => {}
            _ => break,
        }
        rest.next();
    }
    let mut below = Vec::new();
    match rest.peek() {
        Some(':') => {
            rest.next();
            rest.next_if_eq(&':');
            below = tree(rest);
        }
        Some('{') => {
            while rest.next_if(|&letter| letter != '}').is_some() {
                below.extend(tree(rest));
            }
            rest.next();
        }
        _ => {}
    }
    if name.is_empty() {
        return below;
    }
    if below.is_empty() {
        return vec![vec![name]];
    }
    below.into_iter().map(|path| [vec![name.clone()], path].concat()).collect()
}

#[test]
fn paths_of_a_tree_are_found() {
    let found = paths("use crate::{a::B, c::{self, d::E},\n f};\n let g = crate::h::i();", "crate::");
    let found: Vec<String> = found.into_iter().map(|path| path.join("::")).collect();
    assert_eq!(found, ["a::B", "c::self", "c::d::E", "f", "h::i"]);
}
