//! Settings that are words, and how each is written.

use crate::keys::quoted;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;

/// Where environments play.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// In the processes of the run.
    Embedded,
    /// In games of StarCraft II, which actors start and speak to.
    Starcraft,
}

/// Whether armies face each other at a random angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SpawnRotate {
    /// As the authors' code does it for the task set.
    Published,
    /// Always.
    Always,
    /// Never.
    Never,
}

impl SpawnRotate {
    /// Whether they do; as the task set has it where `None`.
    pub fn rotates(self) -> Option<bool> {
        match self {
            Self::Published => None,
            Self::Always => Some(true),
            Self::Never => Some(false),
        }
    }
}

/// Which encoder, where there is a choice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EncoderName {
    /// An agent is one of the entities it attends to.
    Within,
    /// Its own features stand beside what it attends to.
    Beside,
}

/// Which optimiser.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerName {
    /// RMSprop.
    RmsProp,
    /// Adam.
    Adam,
}

/// What ends a run before T_max: every training task of an evaluation has reached it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Until {
    /// Nothing does.
    Never,
    /// A share of episodes won.
    WinRate(f64),
    /// A mean return.
    MeanReturn(f64),
}

impl TryFrom<String> for Until {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let error = || {
            let text = quoted(&text);
            format!(
                "training.until = {text}; write win_rate=NUMBER or mean_return=NUMBER; a win rate lies in 0..=1"
            )
        };
        if text.is_empty() {
            return Ok(Self::Never);
        }
        let (metric, value) = text.split_once('=').ok_or_else(error)?;
        let value: f64 = value.trim().parse().map_err(|_| error())?;
        match metric.trim() {
            "win_rate" if (0.0..=1.0).contains(&value) => Ok(Self::WinRate(value)),
            "mean_return" if value.is_finite() => Ok(Self::MeanReturn(value)),
            _ => Err(error()),
        }
    }
}

impl From<Until> for String {
    fn from(until: Until) -> Self {
        match until {
            Until::Never => Self::new(),
            Until::WinRate(value) => format!("win_rate={value}"),
            Until::MeanReturn(value) => format!("mean_return={value}"),
        }
    }
}

/// The measure that the best policy is kept by: a mean over the training tasks of a scheduled evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum KeepBest {
    /// None is kept.
    Never,
    /// Mean return.
    MeanReturn,
    /// Share of episodes won.
    WinRate,
}

impl KeepBest {
    /// The measure as it is typed; empty where none is kept.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Never => "",
            Self::MeanReturn => "mean_return",
            Self::WinRate => "win_rate",
        }
    }
}

impl TryFrom<String> for KeepBest {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let known = [Self::Never, Self::MeanReturn, Self::WinRate];
        known.into_iter().find(|it| it.name() == text).ok_or_else(|| {
            let text = quoted(&text);
            format!("checkpoints.keep_best = {text}; write mean_return, win_rate, or nothing between quotation marks")
        })
    }
}

impl From<KeepBest> for String {
    fn from(keep_best: KeepBest) -> Self {
        keep_best.name().to_owned()
    }
}

/// Where the learner's web page is served. It speaks plain HTTP, so only this machine gets to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum WebListen {
    /// Nowhere.
    Off,
    /// On this loopback address; with port 0 the system chooses one.
    On(SocketAddr),
}

impl TryFrom<String> for WebListen {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        if text == "off" {
            return Ok(Self::Off);
        }
        match text.parse::<SocketAddr>() {
            Ok(address) if address.ip().is_loopback() => Ok(Self::On(address)),
            Ok(address) => Err(format!(
                "web.listen = {text:?}: the page is served to this machine only; write \"127.0.0.1:{port}\", and \
                 reach it from another machine with ssh -L {port}:127.0.0.1:{port} THIS-MACHINE",
                port = address.port()
            )),
            Err(_) => Err(format!("web.listen = {}; write \"127.0.0.1:PORT\" or \"off\"", quoted(&text))),
        }
    }
}

impl From<WebListen> for String {
    fn from(listen: WebListen) -> Self {
        match listen {
            WebListen::Off => "off".into(),
            WebListen::On(address) => address.to_string(),
        }
    }
}
