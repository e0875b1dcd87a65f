// An OPC UA client of other make that looks at a server and says as JSON what it finds.
// usage: node opcua_client.js '{"url": "opc.tcp://…", "namespace": "urn:…", "read": ["Name", …],
//          "subscribe": ["Name", …], "seconds": 1, "write": ["Name", …]}'
// With "freeze" it subscribes, says so, and then neither reads nor answers until it is killed.
"use strict";
const {
  AttributeIds, DataType, MessageSecurityMode, OPCUAClient, SecurityPolicy,
  TimestampsToReturn, UserTokenType,
} = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const options = JSON.parse(process.argv[2]);

const plain = (value) => ({
  value: value.value?.value ?? null,
  type: DataType[value.value?.dataType ?? 0],
  status: value.statusCode.name,
  time: value.sourceTimestamp?.toISOString() ?? null,
});

async function opened() {
  const secure = options.policy && options.policy !== "None";
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
    securityMode: secure ? MessageSecurityMode.SignAndEncrypt : MessageSecurityMode.None,
    securityPolicy: secure
      ? SecurityPolicy[options.policy === "Aes256Sha256RsaPss" ? "Aes256_Sha256_RsaPss" : options.policy]
      : SecurityPolicy.None,
  });
  await client.connect(options.url);
  return client;
}

async function subscribed(session, id) {
  const seen = Object.fromEntries(options.subscribe.map((name) => [name, []]));
  const subscription = await session.createSubscription2({
    requestedPublishingInterval: 100,
    requestedLifetimeCount: 1000,
    requestedMaxKeepAliveCount: 10,
    publishingEnabled: true,
  });
  for (const name of options.subscribe) {
    const item = await subscription.monitor(
      { nodeId: id(name), attributeId: AttributeIds.Value },
      { samplingInterval: 50, queueSize: 100, discardOldest: true },
      TimestampsToReturn.Both,
    );
    item.on("changed", (value) => seen[name].push(plain(value)));
  }
  await new Promise((done) => setTimeout(done, 1000 * options.seconds));
  return seen;
}

async function main() {
  const client = await opened();
  const user = options.user && { type: UserTokenType.UserName, ...options.user };
  const session = await client.createSession(user);
  const namespaces = await session.readNamespaceArray();
  const index = namespaces.indexOf(options.namespace);
  const id = (name) => (name.startsWith("i=") ? name : `ns=${index};s=${name}`);
  const found = { read: {}, write: {}, seen: {} };
  for (const name of options.read ?? []) {
    found.read[name] = plain(await session.read({ nodeId: id(name), attributeId: AttributeIds.Value }));
  }
  for (const name of options.write ?? []) {
    const value = { dataType: DataType.Double, value: 1.0 };
    const status = await session.write({
      nodeId: id(name), attributeId: AttributeIds.Value, value: { value },
    });
    found.write[name] = status.name;
  }
  if (options.subscribe) found.seen = await subscribed(session, id);
  if (options.freeze) {
    console.log("frozen");
    for (;;); // answers nobody any more
  }
  await session.close();
  await client.disconnect();
  console.log(JSON.stringify(found));
  process.exit(0);
}

main().catch((error) => {
  console.log(JSON.stringify({ error: error.message }));
  process.exit(1);
});
