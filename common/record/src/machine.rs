//! What a run was made with: the build, the host, and the processor time it took.

use serde::{Deserialize, Serialize};
use std::{fs, num::NonZero, thread, time::Duration};

/// The program that trained.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Build {
    /// Its version.
    pub version: String,
    /// The commit it was built from, with `+` after it if files had been changed; none where that is not known, such as
    /// a debug build's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub commit: Option<String>,
    /// Of the processor's vector instructions, those that it found: sums are rounded differently with others.
    #[serde(default)]
    pub target_features: Vec<String>,
}

impl Build {
    /// This program, built from this commit.
    pub fn this(commit: Option<&str>) -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            commit: commit.map(str::to_owned),
            target_features: target_features().into_iter().map(str::to_owned).collect(),
        }
    }
}

#[cfg(target_arch = "x86_64")]
fn target_features() -> Vec<&'static str> {
    let known = [
        ("sse4.2", std::is_x86_feature_detected!("sse4.2")),
        ("avx", std::is_x86_feature_detected!("avx")),
        ("avx2", std::is_x86_feature_detected!("avx2")),
        ("fma", std::is_x86_feature_detected!("fma")),
        ("avx512f", std::is_x86_feature_detected!("avx512f")),
    ];
    known.into_iter().filter(|(_, found)| *found).map(|(name, _)| name).collect()
}

#[cfg(target_arch = "aarch64")]
fn target_features() -> Vec<&'static str> {
    vec!["neon"]
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn target_features() -> Vec<&'static str> {
    Vec::new()
}

/// The machine that the learner ran on.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Host {
    /// Its name.
    pub name: String,
    /// Its processor, as the system calls it; empty where it does not say.
    pub cpu: String,
    /// Processors that the learner could use.
    pub cores: usize,
}

impl Host {
    /// This machine.
    pub fn this() -> Self {
        let read = |path: &str| fs::read_to_string(path).unwrap_or_default();
        let cpuinfo = read("/proc/cpuinfo");
        let model = cpuinfo.lines().find_map(|line| line.strip_prefix("model name"));
        Self {
            name: read("/proc/sys/kernel/hostname").trim().to_owned(),
            cpu: model.map_or("", |model| model.trim_start_matches([' ', '\t', ':'])).to_owned(),
            cores: thread::available_parallelism().map_or(1, NonZero::get),
        }
    }
}

/// Seconds of processor time that this process has taken, user and system of all its threads.
pub fn cpu_seconds() -> f64 {
    let taken = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::try_from(taken).map_or(0.0, |taken| taken.as_secs_f64())
}
