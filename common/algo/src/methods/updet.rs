//! UPDeT: each agent's tokens go through a transformer's block, and a hidden token among them remembers.

use crate::{
    ModelConfig,
    blocks::{Encoder, Mixer},
    drive::{Head, Pass, Utilities, ValueNetwork, ValueParts, measures},
    learner::Measure,
    method::Mixing,
};
use rit_nn::{HiddenToken, Layout, LayoutBuilder, Linear, Tape, attention::Visible, hidden_token::Places};

/// The utility network, and all else in [`ValueParts`].
#[derive(Clone, Debug)]
pub struct Updet {
    parts: ValueParts,
    /// d → h.
    embed: Linear,
    block: HiddenToken,
    /// h → A.
    head: Linear,
}

impl Updet {
    /// Declares the networks: utility, then mixer.
    pub fn new(config: &ModelConfig) -> Self {
        let (mut network, layout) = Layout::of(|layout| Self::declare(config, layout));
        network.parts.layout = layout;
        network
    }

    fn declare(config: &ModelConfig, layout: &mut LayoutBuilder) -> Self {
        let (h, a) = (config.hidden_dim, config.attention_dim);
        let embed = Linear::new(layout, "utility.embed", config.entity_dim, h);
        let block = HiddenToken::new(layout, "utility", h, a, config.n_heads, config.feedforward_dim);
        let head = Linear::new(layout, "utility.head", h, config.n_actions);
        let acting = 0..layout.len();
        let mixer = (config.method.facts().mixing == Some(Mixing::Network)).then(|| {
            let encoder = Encoder::new(layout, "mixer", config.entity_dim, h, a, config.n_heads);
            Mixer::new(layout, encoder, 0, config.mixing_embed_dim, config.hypernet_embed_dim)
        });
        let target = 0..layout.len();
        let layout = Layout::default();
        let n_actions = config.n_actions;
        let parts =
            ValueParts { layout, acting, target, n_actions, memory_dim: h, gru: false, mixer, task: None };
        Self { parts, embed, block, head }
    }
}

impl ValueNetwork for Updet {
    type Draws = ();
    type Inputs = ();
    type Extras = ();

    fn parts(&self) -> &ValueParts {
        &self.parts
    }

    fn measures(&self) -> &'static [Measure] {
        &measures::TD
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, pass: Pass<'a, ()>) -> Utilities<'a, ()> {
        let rows = pass.rows;
        let places = Places {
            groups: &rows.groups,
            group_times: &rows.group_times,
            agent_times: &rows.agent_times,
            visible: Visible::Where(&rows.observable),
        };
        let entities = tape.constant(rows.entities());
        let x = tape.linear_relu(&self.embed, entities);
        let (own, memory) = tape.hidden_token(&self.block, x, places, pass.before);
        tape.free(x);
        let utilities = tape.linear(&self.head, own);
        tape.free(own);
        Utilities { memory, head: Head::Independent(utilities), extras: () }
    }
}
