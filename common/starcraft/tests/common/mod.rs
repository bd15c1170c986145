//! What the tests of client and endpoint share.

#![allow(dead_code, reason = "each test uses what it needs")]

use rit_env::{Task, TaskSet, combat::CombatSet};
use rit_episode::RunSeed;
use rit_starcraft::{
    Settings, StarCraft, Wanted,
    endpoint::{Endpoint, Options},
};
use std::{net::SocketAddr, thread, time::Duration};

/// An endpoint that listens until the test's process ends.
pub fn endpoint(options: Options) -> SocketAddr {
    let endpoint = Endpoint::bind(([127, 0, 0, 1], 0).into(), options).unwrap();
    let address = endpoint.address().unwrap();
    thread::spawn(move || endpoint.serve());
    address
}

pub fn settings() -> Settings {
    Settings {
        wanted: Wanted { map: "empty_passive".into(), ..Wanted::default() },
        custom_types: 0,
        timeout: Duration::from_secs(30),
        spawn_rotate: None,
        games_max: 8,
        seed: RunSeed(7),
    }
}

/// The worlds of a set in games at this address.
pub fn at(address: SocketAddr, set: CombatSet) -> StarCraft {
    StarCraft::at(address, set, settings())
}

pub fn task(set: CombatSet, name: &str) -> Task {
    TaskSet::Combat(set).task(name).unwrap()
}
