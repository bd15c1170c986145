//! MAPPO: every agent chooses on its own, from what it has seen so far; a critic values the whole state.

mod acting;

pub use acting::MappoActing;

use crate::{
    Rows,
    flat::Slots,
    learner::Measure,
    networks::Actor,
    on_policy::{self, ActorCritic, Inputs, Outputs, ValueRows},
};
use rit_nn::{
    Gru, LayerNorm, Layout, LayoutBuilder, Linear, View,
    tape::{Tape, Var},
};
use std::{f32::consts::SQRT_2, ops::Range, sync::Arc};

/// What an update reports.
const MEASURES: [Measure; 10] = on_policy::measures([
    Measure { name: "actor_grad_norm", help: "Norm of the actor's gradient before clipping" },
    Measure { name: "critic_grad_norm", help: "Norm of the critic's gradient before clipping" },
]);

/// Sizes of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MappoConfig {
    /// Slots of the flat inputs.
    pub slots: Slots,
    /// A.
    pub n_actions: usize,
    /// h.
    pub hidden_dim: usize,
}

/// The networks. The actor's parameters come first: acting needs no others.
#[derive(Clone, Debug)]
pub struct Mappo {
    /// What it was made from.
    pub config: MappoConfig,
    layout: Layout,
    actor: Tower,
    critic: Tower,
    acting_len: usize,
}

impl Mappo {
    /// Declares all parameters.
    pub fn new(config: MappoConfig) -> Self {
        let mut layout = LayoutBuilder::default();
        let (slots, h) = (config.slots, config.hidden_dim);
        let actor = Tower::new(&mut layout, "actor", slots, h, ("head", config.n_actions, 0.01));
        let acting_len = layout.len();
        let critic = Tower::new(&mut layout, "critic", slots, h, ("value", 1, 1.0));
        Self { config, layout: layout.finish(), actor, critic, acting_len }
    }

    /// One step of acting: the actor's histories and logits, (R, h) and (R, A). `before` (R, h) are the histories
    /// before it.
    pub fn act<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, observations: Var, before: Var) -> (Var, Var) {
        self.actor.forward(tape, observations, &rows.agent_times, Some(before))
    }
}

impl ActorCritic for Mappo {
    fn layout(&self) -> &Layout {
        &self.layout
    }

    fn acting(&self) -> Range<usize> {
        0..self.acting_len
    }

    fn clipped_apart(&self) -> Vec<Range<usize>> {
        vec![0..self.acting_len, self.acting_len..self.layout.len()]
    }

    fn n_actions(&self) -> usize {
        self.config.n_actions
    }

    fn value_rows(&self) -> ValueRows {
        ValueRows::States
    }

    fn measures(&self) -> &'static [Measure] {
        const { &MEASURES }
    }

    fn fill(&self, inputs: &mut Inputs) {
        self.config.slots.observations(&inputs.rows, &mut inputs.observations);
        self.config.slots.states(&inputs.rows, &mut inputs.states);
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, inputs: &'a Inputs) -> Outputs {
        let width = self.config.slots.width();
        let observations = tape.constant(View::dense(&inputs.observations, width));
        let states = tape.constant(View::dense(&inputs.states, width));
        let (_, logits) = self.actor.forward(tape, observations, &inputs.rows.agent_times, None);
        let (_, values) = self.critic.forward(tape, states, &inputs.rows.group_times, None);
        Outputs { logits, values }
    }

    fn actor(self: Arc<Self>, params: &[f32]) -> Box<dyn Actor> {
        Box::new(MappoActing::new(self, params))
    }
}

/// What actor and critic are alike: two hidden layers and a recurrent one, each normalised, under a last layer.
#[derive(Clone, Debug)]
struct Tower {
    input_norm: LayerNorm,
    hidden: [(Linear, LayerNorm); 2],
    gru: Gru,
    gru_norm: LayerNorm,
    head: Linear,
}

impl Tower {
    /// Declares `{name}.…`; `head` is the last layer's name, outputs and initial gain.
    fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        slots: Slots,
        h: usize,
        (head, outputs, gain): (&str, usize, f32),
    ) -> Self {
        let of = |part: &str| format!("{name}.{part}");
        let input_norm = LayerNorm::new(layout, &of("input_norm"), slots.width());
        let mut hidden = |index: usize, inputs: usize| {
            let layer = format!("{name}.fc{index}");
            let layer = layout.orthogonal(SQRT_2, |layout| Linear::new(layout, &layer, inputs, h));
            (layer, LayerNorm::new(layout, &format!("{name}.norm{index}"), h))
        };
        let hidden = [hidden(1, slots.width()), hidden(2, h)];
        let gru = layout.orthogonal(1.0, |layout| Gru::new(layout, &of("gru"), h, h));
        let gru_norm = LayerNorm::new(layout, &of("gru_norm"), h);
        let head = layout.orthogonal(gain, |layout| Linear::new(layout, &of(head), h, outputs));
        Self { input_norm, hidden, gru, gru_norm, head }
    }

    /// The recurrent layer's states and the last layer's outputs, from `x` (rows in time order, m d).
    fn forward<'a>(
        &self,
        tape: &mut Tape<'a>,
        x: Var,
        times: &'a [usize],
        before: Option<Var>,
    ) -> (Var, Var) {
        let mut x = tape.layer_norm(&self.input_norm, x);
        for (layer, norm) in &self.hidden {
            let y = tape.linear_relu(layer, x);
            tape.free(x);
            x = tape.layer_norm(norm, y);
            tape.free(y);
        }
        let gates = tape.product_of(&self.gru.input, 0, &[x]);
        tape.free(x);
        let history = tape.gru(&self.gru, gates, times, before);
        let y = tape.layer_norm(&self.gru_norm, history);
        let out = tape.linear(&self.head, y);
        tape.free(y);
        (history, out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_parameters_as_pinned() {
        let slots = Slots { agents_max: 6, entities_max: 12, entity_dim: 12 };
        let mappo = Mappo::new(MappoConfig { slots, n_actions: 5, hidden_dim: 64 });
        assert_eq!(mappo.layout.len(), 78_534);
        let named = |range: Range<usize>, prefix: &str| {
            let mut params = mappo.layout.params().iter().filter(|param| range.contains(&param.range.start));
            params.all(|param| param.name.starts_with(prefix))
        };
        let [actor, critic] = &mappo.clipped_apart()[..] else { panic!("two parts") };
        assert!(named(actor.clone(), "actor.") && named(critic.clone(), "critic."));
        assert_eq!(mappo.acting(), *actor);
    }
}
