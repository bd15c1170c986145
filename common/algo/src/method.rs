//! The algorithms there are: their names, and the facts that set them apart.

use rit_episode::Choice;
use std::{fmt, str::FromStr};

/// An algorithm: what `algorithm.name` and `--algorithm` name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs, reason = "Facts::summary says what each is")]
pub enum Method {
    Rit,
    RitVdn,
    RitNoTaskRepresentations,
    QmixAttn,
    VdnAttn,
    QmixInt,
    VdnInt,
    UpdetMix,
    UpdetVdn,
    Refil,
    Roma,
    Mappo,
    Mat,
}

/// What a method learns from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Regime {
    /// Batches sampled from replay, whichever weights rolled them; a target network; ε-greedy exploration.
    Replay,
    /// Each batch once, rolled with the weights that learn from it; actions are sampled from the policy.
    OnPolicy,
}

/// How entities become what an agent's history is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Encoder {
    /// An agent's own features beside its attention over the other entities it sees: RIT's.
    Beside,
    /// Its attention over all entities it sees, itself among them.
    Within,
    /// One row of a transformer's block, with a hidden token in place of a recurrent network: UPDeT.
    Tokens,
    /// All entities' features in a row of fixed length: MAPPO and MAT.
    Flat,
}

impl Encoder {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Beside, Self::Within, Self::Tokens, Self::Flat];

    /// What a weights file calls it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Beside => "beside",
            Self::Within => "within",
            Self::Tokens => "tokens",
            Self::Flat => "flat",
        }
    }
}

/// How utilities become Q_total.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Mixing {
    /// The mixing network.
    Network,
    /// Their sum.
    Sum,
}

/// What sets a method apart.
#[derive(Clone, Copy, Debug)]
pub struct Facts {
    /// Its name in configuration.
    pub name: &'static str,
    /// What it is, in a few words.
    pub summary: &'static str,
    /// What it learns from.
    pub regime: Regime,
    /// Its encoder, unless configuration says otherwise.
    pub encoder: Encoder,
    /// Whether it has task representations, and the loss that makes them.
    pub task_representations: bool,
    /// How it mixes utilities; `None` where there are none.
    pub mixing: Option<Mixing>,
    /// Whether an agent's choice depends on the choices of those before it.
    pub ordered: bool,
}

impl Method {
    /// All of them, in the order in which they are listed to people.
    pub const ALL: [Self; 13] = [
        Self::Rit,
        Self::RitVdn,
        Self::RitNoTaskRepresentations,
        Self::QmixAttn,
        Self::VdnAttn,
        Self::QmixInt,
        Self::VdnInt,
        Self::UpdetMix,
        Self::UpdetVdn,
        Self::Refil,
        Self::Roma,
        Self::Mappo,
        Self::Mat,
    ];

    /// What sets it apart.
    pub const fn facts(self) -> Facts {
        use {Encoder as E, Mixing as M};
        let rit = Facts {
            name: "rit",
            summary: "interactions and task representations, mixing network",
            regime: Regime::Replay,
            encoder: E::Beside,
            task_representations: true,
            mixing: Some(M::Network),
            ordered: true,
        };
        // What all rivals of the value-based family share.
        let rival = Facts { encoder: E::Within, task_representations: false, ..rit };
        let independent = Facts { ordered: false, ..rival };
        let on_policy = Facts { regime: Regime::OnPolicy, encoder: E::Flat, mixing: None, ..independent };
        match self {
            Self::Rit => rit,
            Self::RitVdn => {
                let summary = "RIT with the sum of utilities in place of the mixing network";
                Facts { name: "rit-vdn", summary, mixing: Some(M::Sum), ..rit }
            }
            Self::RitNoTaskRepresentations => {
                let (name, summary) = ("rit-no-task-representations", "RIT without task representations");
                Facts { name, summary, task_representations: false, ..rit }
            }
            Self::QmixAttn => {
                let summary = "QMIX on attention over entities";
                Facts { name: "qmix-attn", summary, ..independent }
            }
            Self::VdnAttn => {
                let summary = "VDN on attention over entities";
                Facts { name: "vdn-attn", summary, mixing: Some(M::Sum), ..independent }
            }
            Self::QmixInt => {
                let summary = "qmix-attn with RIT's interactive utilities";
                Facts { name: "qmix-int", summary, ..rival }
            }
            Self::VdnInt => {
                let summary = "vdn-attn with RIT's interactive utilities";
                Facts { name: "vdn-int", summary, mixing: Some(M::Sum), ..rival }
            }
            Self::UpdetMix => {
                let summary = "UPDeT: a transformer with a recurrent hidden token, mixing network";
                Facts { name: "updet-mix", summary, encoder: E::Tokens, ..independent }
            }
            Self::UpdetVdn => {
                let (summary, mixing) = ("UPDeT with the sum of utilities", Some(M::Sum));
                Facts { name: "updet-vdn", summary, encoder: E::Tokens, mixing, ..independent }
            }
            Self::Refil => {
                let summary = "REFIL: qmix-attn that also mixes imagined sub-groups";
                Facts { name: "refil", summary, ..independent }
            }
            Self::Roma => {
                let summary = "ROMA: utilities generated by learned roles, mixing network";
                Facts { name: "roma", summary, ..independent }
            }
            Self::Mappo => {
                let summary = "MAPPO: on-policy, agents choose on their own";
                Facts { name: "mappo", summary, ..on_policy }
            }
            Self::Mat => {
                let summary = "Multi-Agent Transformer: on-policy, agents choose one after another";
                Facts { name: "mat", summary, ordered: true, ..on_policy }
            }
        }
    }

    /// How actions come about in training, where a random one has this probability if the method explores so.
    pub const fn exploring(self, epsilon: f32) -> Choice {
        match self.facts().regime {
            Regime::Replay => Choice::EpsilonGreedy(epsilon),
            Regime::OnPolicy => Choice::Sampled,
        }
    }

    /// Its name in configuration.
    pub const fn name(self) -> &'static str {
        self.facts().name
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A name that no method has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown algorithm {name:?}; known: {}", Method::ALL.map(Method::name).join(", "))]
pub struct UnknownMethod {
    /// The name.
    pub name: String,
}

impl FromStr for Method {
    type Err = UnknownMethod;

    fn from_str(name: &str) -> Result<Self, UnknownMethod> {
        let found = Self::ALL.into_iter().find(|method| method.name() == name);
        found.ok_or_else(|| UnknownMethod { name: name.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_leads_back_to_its_method() {
        for (index, method) in Method::ALL.into_iter().enumerate() {
            assert_eq!(method as usize, index, "listed once");
            assert_eq!(method.to_string().parse(), Ok(method));
        }
        let error = "qmix".parse::<Method>().unwrap_err().to_string();
        assert!(error.starts_with("unknown algorithm \"qmix\"; known: rit, rit-vdn, "), "{error}");
        assert!(error.ends_with(", mappo, mat"), "{error}");
    }

    /// The table of the specification of the rivals, §1.
    #[test]
    fn facts_are_those_of_the_table() {
        let named = |holds: fn(&Facts) -> bool| -> Vec<&str> {
            let names = Method::ALL.map(Method::facts).into_iter().filter(holds).map(|facts| facts.name);
            names.collect()
        };
        assert_eq!(named(|facts| facts.task_representations), ["rit", "rit-vdn"]);
        assert_eq!(
            named(|facts| facts.mixing == Some(Mixing::Sum)),
            ["rit-vdn", "vdn-attn", "vdn-int", "updet-vdn"]
        );
        assert_eq!(
            named(|facts| facts.ordered),
            ["rit", "rit-vdn", "rit-no-task-representations", "qmix-int", "vdn-int", "mat"]
        );
        assert_eq!(named(|facts| facts.regime == Regime::OnPolicy), ["mappo", "mat"]);
        assert_eq!(
            named(|facts| facts.encoder == Encoder::Within),
            ["qmix-attn", "vdn-attn", "qmix-int", "vdn-int", "refil", "roma"]
        );
    }
}
