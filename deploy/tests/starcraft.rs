//! Real games, without the game: an installation whose program is the endpoint over the simulator, which `rit` starts,
//! speaks to, loses and replaces as it would StarCraft II.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, actor_pid, kill, refused, rit};
use rustix::process::Signal;
use serde_json::Value;
use std::{
    fs,
    io::{BufRead as _, BufReader},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

/// Far beyond what any step of a test takes on a slow machine: reached only when something hangs.
const DEADLINE: Duration = Duration::from_secs(120);

/// A little run in games.
const RUN: &[&str] = &[
    "3-8m",
    "--set",
    "environment.backend=starcraft",
    "--set",
    "environment.training_tasks=3m,2m",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "algorithm.batch_size=4",
    "--set",
    "actors.episodes_at_once=2",
];

/// A folder as the game's, with a map, and this shell script as its program.
fn installation(folder: &Path, program: &str) -> PathBuf {
    let game = folder.join("StarCraftII");
    let (version, maps) = (game.join("Versions/Base75689"), game.join("Maps/SMAC_Maps"));
    fs::create_dir_all(&version).unwrap();
    fs::create_dir_all(&maps).unwrap();
    fs::write(maps.join("empty_passive.SC2Map"), "a map").unwrap();
    // Written by another process: one that is forked off meanwhile must not hold it open for writing.
    let script = format!("#!/bin/sh\n{program}\n");
    let made = Command::new("sh")
        .args(["-c", "printf '%s' \"$1\" > \"$2\" && chmod 755 \"$2\"", "sh", &script])
        .arg(version.join("SC2_x64"))
        .status();
    assert!(made.unwrap().success());
    game
}

/// The endpoint as the game's program.
fn stand_in() -> String {
    format!("exec '{}' starcraft-endpoint \"$@\"", env!("CARGO_BIN_EXE_rit"))
}

fn with_game(game: &Path, arguments: &[&str]) -> Command {
    let mut command = rit(arguments);
    command.env("SC2PATH", game);
    command
}

fn output(game: &Path, arguments: &[&str]) -> Output {
    with_game(game, arguments).output().unwrap()
}

fn train(folder: &RunFolder, game: &Path, arguments: &[&str]) -> Train {
    folder.start_as(with_game(game, &[]), &[&["--json"], RUN, arguments].concat())
}

/// Games of this folder that run now, by their parents.
fn games(game: &Path) -> Vec<(u32, u32)> {
    let data = game.join("").display().to_string();
    let pids =
        fs::read_dir("/proc").unwrap().filter_map(|entry| entry.unwrap().file_name().to_str()?.parse().ok());
    let game = |pid: u32| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).ok()?;
        let is_ours = line.contains("starcraft-endpoint") && line.split('\0').any(|word| word == data);
        let status = fs::read_to_string(format!("/proc/{pid}/status")).ok().filter(|_| is_ours)?;
        let parent = status.lines().find_map(|line| line.strip_prefix("PPid:"))?.trim().parse().ok()?;
        // A zombie's command line is empty, so those that are listed live.
        Some((pid, parent))
    };
    pids.filter_map(game).collect()
}

/// Waits until something holds.
#[track_caller]
fn wait_until<T>(what: &str, mut holds: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(value) = holds() {
            return value;
        }
        assert!(begun.elapsed() < DEADLINE, "waiting for {what}");
        std::thread::yield_now();
    }
}

#[test]
fn a_run_in_games_comes_to_its_end_and_leaves_none_behind() {
    let folder = RunFolder::new();
    let game = installation(folder.path(), &stand_in());
    let summary = train(&folder, &game, &["--actors", "2", "--steps", "600"]).finish();
    assert_eq!(summary["ended"], "finished");
    assert!(summary["env_steps"].as_u64().unwrap() >= 600);
    assert_eq!(summary["evaluation"]["3m"]["episodes"], 2, "{summary}");
    wait_until("the games' end", || games(&game).is_empty().then_some(()));
    // It goes on as embedded: what a policy has learned is the same policy's elsewhere.
    let run = folder.run_dir();
    let run = run.to_str().unwrap();
    let evaluated = |backend| {
        let arguments =
            ["evaluate", "--json", "--run", run, "--episodes", "3", "--tasks", "3m", "--backend", backend];
        let output = output(&game, &arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let (real, embedded) = (evaluated("starcraft"), evaluated("embedded"));
    assert_eq!(real["weights_digest"], embedded["weights_digest"]);
    assert_eq!(real["tasks"]["3m"]["episodes"], 3);
}

#[test]
fn games_that_die_are_replaced_and_their_episodes_rolled_again() {
    let folder = RunFolder::new();
    let game = installation(folder.path(), &stand_in());
    let mut train = train(&folder, &game, &["--actors", "1", "--steps", "100k"]);
    let status = train.wait_for("an episode", |status| status["ledger"]["inserted"].as_u64() > Some(3));
    let actor = actor_pid(&status, "actor-0").unwrap();
    let of_actor = |games: Vec<(u32, u32)>| games.into_iter().find(|(_, parent)| *parent == actor);
    let (victim, _) = wait_until("a game", || of_actor(games(&game)));
    kill(victim, Signal::KILL);
    let status =
        train.wait_for("a loss", |status| !status["ledger"]["rejected"]["environment_died"].is_null());
    assert_eq!(actor_pid(&status, "actor-0"), Some(actor), "the actor goes on");
    let happenings = status["happenings"].as_array().unwrap();
    let lost = |it: &&Value| it["what"].as_str().unwrap().contains("which are handed out again: ");
    assert!(happenings.iter().any(|it| lost(&it) && it["warning"] == true), "{happenings:?}");
    let inserted = status["ledger"]["inserted"].as_u64();
    train.wait_for("more", |status| status["ledger"]["inserted"].as_u64() > inserted.map(|count| count + 4));

    // A killed actor's games go with it.
    let orphans: Vec<u32> =
        games(&game).iter().filter(|(_, parent)| *parent == actor).map(|it| it.0).collect();
    assert!(!orphans.is_empty());
    kill(actor, Signal::KILL);
    wait_until("the orphans' end", || {
        let living: Vec<u32> = games(&game).iter().map(|(pid, _)| *pid).collect();
        orphans.iter().all(|pid| !living.contains(pid)).then_some(())
    });
    train.wait_for("the next actor", |status| {
        actor_pid(status, "actor-0").is_some_and(|pid| pid != actor) && status["ledger"]["outstanding"] != 0
    });
    train.ctl(&["stop"]);
    train.finish_stopped();
    wait_until("the games' end", || games(&game).is_empty().then_some(()));
}

/// What a broken game's program does.
const BROKEN: &str = "echo 'error while loading shared libraries: libGL.so.1' >&2; exit 127";

/// What is said of it.
const WORDS: [&str; 3] = ["SC2_x64 ended before it could be spoken to", "exit status: 127", "libGL.so.1"];

#[test]
fn a_game_that_never_comes_up_ends_the_run_with_its_last_words() {
    let folder = RunFolder::new();
    let game = installation(folder.path(), BROKEN);
    // The learner evaluates before the first update.
    let ended = train(&folder, &game, &["--actors", "1", "--steps", "100k"]).wait();
    assert_eq!(ended.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&ended.stderr);
    let error = stderr.lines().find(|line| line.starts_with("error: ")).unwrap();
    for part in WORDS {
        assert!(error.contains(part), "{part} in {error}");
    }
}

#[test]
fn games_that_cannot_be_replaced_end_their_actor_with_the_last_words() {
    let folder = RunFolder::new();
    let broken = folder.path().join("broken");
    let program = format!("if [ -e '{}' ]; then {BROKEN}; fi\n{}", broken.display(), stand_in());
    let game = installation(folder.path(), &program);
    // An evaluation that found the games broken would end the run, so the first one is waited for, and none comes soon after.
    let evaluations = ["--set", "evaluation.testing_every_env_steps=0"];
    let mut train =
        train(&folder, &game, &[&["--actors", "1", "--steps", "100k"], &evaluations[..]].concat());
    let status = train.wait_for("episodes and an evaluation", |status| {
        status["ledger"]["inserted"].as_u64() > Some(3) && !status["evaluation"].is_null()
    });
    let actor = actor_pid(&status, "actor-0").unwrap();
    fs::write(&broken, "").unwrap();
    for (victim, _) in games(&game).iter().filter(|(_, parent)| *parent == actor) {
        kill(*victim, Signal::KILL);
    }
    let log = folder.run_dir().join("logs/actor-0.log");
    let words = wait_until("its last words", || {
        let log = fs::read_to_string(&log).unwrap();
        log.lines().find(|line| line.contains("times in a row every episode was lost")).map(str::to_owned)
    });
    for part in WORDS {
        assert!(words.contains(part), "{part} in {words}");
    }
    let died = |status: &Value| status["ledger"]["rejected"]["environment_died"].as_u64();
    let status = train.wait_for("losses", |status| died(status) > Some(2));
    assert!(status["ledger"]["rejected"]["not_arrived"].is_null(), "{}", status["ledger"]);
    // Once it can be played again, the run goes on.
    fs::remove_file(&broken).unwrap();
    let inserted = status["ledger"]["inserted"].as_u64();
    train.wait_for("more", |status| status["ledger"]["inserted"].as_u64() > inserted);
    train.ctl(&["stop"]);
    train.finish_stopped();
}

#[test]
fn what_is_missing_is_said_before_a_run_has_begun() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let nowhere = folder.path().join("nowhere");
    let game = installation(folder.path(), &stand_in());
    let run =
        ["train", "--run-dir", run_dir.to_str().unwrap(), "3-8m", "--set", "environment.backend=starcraft"];
    let refused = |game: &Path, more: &[&str], parts: &[&str]| {
        let output = output(game, &[&run, more].concat());
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        for part in parts {
            assert!(stderr.contains(part), "{part:?} in {stderr}");
        }
        assert!(!run_dir.exists(), "nothing has begun");
    };
    refused(&nowhere, &[], &["no StarCraft II at", "nowhere (SC2PATH)", "s2client-proto#downloads"]);
    let map = ["--set", "starcraft.map=full_map_template"];
    refused(&game, &map, &["Maps/SMAC_Maps/full_map_template.SC2Map cannot be read", "starcraft.map"]);
    let build = ["--set", "starcraft.base_build=55958"];
    refused(&game, &build, &["starcraft.base_build = 55958 is not installed", "there are: 75689"]);
    fs::remove_file(game.join("Versions/Base75689/SC2_x64")).unwrap();
    refused(&game, &[], &["SC2_x64 is missing"]);
}

#[test]
fn settings_that_mean_nothing_there_are_refused() {
    let train = |settings: &[&str]| -> Vec<String> {
        let sets = settings.iter().flat_map(|setting| ["--set".to_owned(), (*setting).to_owned()]);
        ["train".to_owned()].into_iter().chain(sets).collect()
    };
    for (experiment, settings, words) in [
        ("matrix-game", &["environment.backend=starcraft"][..], "plays combat, and matrix-game is none"),
        ("3-8m", &["environment.backend=real"], "is not one of: embedded, starcraft"),
        ("3-8m", &["starcraft.custom_types=1970"], "starcraft.custom_types means nothing with"),
        (
            "3-8m",
            &["environment.backend=starcraft", "environment.stats=ladder"],
            "environment.stats means nothing with environment.backend = \"starcraft\"",
        ),
        ("3-8m", &["starcraft.timeout_ms=1"], "starcraft.timeout_ms = 1 is out of range"),
        (
            "3-8m",
            &["starcraft.map=other"],
            "starcraft.map means nothing with environment.backend = \"embedded\"",
        ),
    ] {
        let arguments = train(settings);
        let mut arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        arguments.insert(1, experiment);
        refused(&arguments, &[words]);
    }
}

#[test]
fn a_check_plays_a_battle_and_saves_what_the_game_gives() {
    let folder = RunFolder::new();
    let game = installation(folder.path(), &stand_in());
    let replay = folder.path().join("battle.SC2Replay");
    let arguments = ["starcraft-check", "3-8sz", "--replay", replay.to_str().unwrap()];
    let checked = output(&game, &arguments);
    let said = String::from_utf8_lossy(&checked.stdout);
    assert!(checked.status.success(), "{said} {}", String::from_utf8_lossy(&checked.stderr));
    for part in [
        "Base75689/SC2_x64",
        "empty_passive.SC2Map",
        "4.10.0, build 75689",
        "Zealot 1942",
        "3s, random actions",
    ] {
        assert!(said.contains(part), "{part:?} in {said}");
    }
    assert!(fs::read_to_string(&replay).unwrap().contains("loops of a simulator"));
    let again = output(&game, &arguments);
    assert_eq!(again.status.code(), Some(2), "the file is there already");
    let nowhere = output(Path::new("/nowhere"), &["starcraft-check"]);
    assert_eq!(nowhere.status.code(), Some(2));
}

/// Outside the default suite, since it needs PySC2: in a virtual environment `pip install --no-deps PySC2==4.0.0`, and
/// `pip install absl-py dm-env mock mpyq numpy portpicker protobuf==3.20.3 requests s2clientprotocol sk-video six
/// websocket-client whichcraft`; then `RIT_PYTHON=VENV/bin/python cargo test -p rit --test starcraft -- --ignored`.
#[test]
#[ignore = "needs Python with PySC2"]
fn the_published_python_client_plays() {
    let folder = RunFolder::new();
    let program = stand_in().replace("starcraft-endpoint", "starcraft-endpoint --control-enemy sticky");
    let game = installation(folder.path(), &program);
    let maps = ["3m", "2s3z", "MMM", "1c3s5z", "empty_passive", "full_map_template"];
    for map in maps {
        fs::write(game.join(format!("Maps/SMAC_Maps/{map}.SC2Map")), "a map").unwrap();
    }
    let python = std::env::var("RIT_PYTHON").unwrap_or_else(|_| "python3".into());
    let played = Command::new(python)
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pysc2_client.py"))
        .arg("3")
        .args(maps)
        .env("SC2PATH", &game)
        .env("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", "python")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&played.stdout);
    assert!(played.status.success(), "{said} {}", String::from_utf8_lossy(&played.stderr));
    println!("{said}");
    assert_eq!(said.lines().filter(|line| line.contains(" against ")).count(), 3 * maps.len());
    assert!(said.contains("2s3z 5 against 5: ") && said.contains("MMM 10 against 10: "), "{said}");
}

#[test]
fn an_endpoint_says_where_it_listens_and_ends_in_order() {
    let mut endpoint =
        rit(&["starcraft-endpoint", "--listen", "127.0.0.1:0"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(endpoint.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.starts_with("listening on ws://127.0.0.1:") && line.ends_with("/sc2api\n"), "{line}");
    kill(endpoint.id(), Signal::TERM);
    assert!(endpoint.wait().unwrap().success());

    let taken = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let address = taken.local_addr().unwrap().to_string();
    refused(&["starcraft-endpoint", "--listen", &address], &[&format!("{address} is in use"), "--listen"]);
    refused(&["starcraft-endpoint", "--listen", "5000"], &["--listen"]);
}
