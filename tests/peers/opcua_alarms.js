// An OPC UA client of other make that watches alarms, and answers "> JSON" to each command that it
// reads: {"do": "list"}, {"do": "refresh"}, {"do": "acknowledge", "alarm": NAME,
// "comment": TEXT}, {"do": "quit"}.
// usage: node opcua_alarms.js '{"url": "opc.tcp://…", "folder": "…", "user": {…}, …}'
"use strict";
const readline = require("node:readline");
const {
  AttributeIds, MessageSecurityMode, OPCUAClient, SecurityPolicy,
  TimestampsToReturn, UserTokenType, callConditionRefresh, constructEventFilter, ofType,
  resolveNodeId,
} = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const options = JSON.parse(process.argv[2]);
const FIELDS = [
  "EventId", "EventType", "SourceName", "Time", "Message", "Severity", "ConditionName", "BranchId",
  "Retain", "ActiveState", "ActiveState.Id", "AckedState", "AckedState.Id", "EnabledState.Id",
  "SuppressedOrShelved", "InputNode", "SetpointNode", "ClientUserId", "ConditionId",
];

async function opened() {
  const manager = new OPCUACertificateManager({
    rootFolder: options.folder,
    automaticallyAcceptUnknownCertificate: true,
  });
  await manager.initialize();
  const client = OPCUAClient.create({
    applicationName: "peer",
    ...(options.uri && { applicationUri: options.uri }),
    ...(options.certificate && { certificateFile: options.certificate, privateKeyFile: options.key }),
    clientCertificateManager: manager,
    endpointMustExist: false,
    connectionStrategy: { maxRetry: 0 },
    securityMode: options.policy ? MessageSecurityMode.SignAndEncrypt : MessageSecurityMode.None,
    securityPolicy: options.policy ? SecurityPolicy[options.policy] : SecurityPolicy.None,
  });
  await client.connect(options.url);
  return client;
}

const text = (variant) => variant.value?.text ?? variant.value?.toString() ?? null;

async function main() {
  const client = await opened();
  const session = await client.createSession(
    options.user && { type: UserTokenType.UserName, ...options.user },
  );
  const subscription = await session.createSubscription2({
    requestedPublishingInterval: 50,
    requestedLifetimeCount: 1000,
    requestedMaxKeepAliveCount: 10,
    publishingEnabled: true,
  });
  const filter = constructEventFilter(FIELDS, ofType(resolveNodeId("AcknowledgeableConditionType")));
  const item = await subscription.monitor(
    { nodeId: resolveNodeId("Server"), attributeId: AttributeIds.EventNotifier },
    { samplingInterval: 0, queueSize: 1000, discardOldest: false, filter },
    TimestampsToReturn.Both,
  );
  let events = [];
  const newest = {};
  item.on("changed", (values) => {
    const event = Object.fromEntries(FIELDS.map((name, at) => [name, values[at]]));
    newest[text(event.ConditionName)] = event;
    const plain = (name) => (typeof event[name].value === "object" ? text(event[name]) : event[name].value);
    events.push(Object.fromEntries(
      FIELDS.filter((name) => name !== "EventId").map((name) => [name, plain(name)]),
    ));
  });
  const answers = {
    list: async () => events.splice(0),
    refresh: async () => {
      events = [];
      return (await callConditionRefresh(session, subscription.subscriptionId)).name;
    },
    acknowledge: async ({ alarm, comment }) => {
      const { ConditionId, EventId } = newest[alarm];
      const id = ConditionId.value;
      return (await session.acknowledgeCondition(id, EventId.value, comment ?? "")).name;
    },
    quit: async () => {
      await session.close();
      await client.disconnect();
      process.exit(0);
    },
  };
  console.log("> ready");
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const command = JSON.parse(line);
    console.log(`> ${JSON.stringify(await answers[command.do](command))}`);
  }
}

main().catch((error) => {
  console.log(`> ${JSON.stringify({ error: error.message })}`);
  process.exit(1);
});
